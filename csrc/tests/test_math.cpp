// Rotations, projection and harmonics of csrc/math: every hand-derived vjp against central differences in double, the
// forward passes against plain formulas in long double, and packets against scalars. Prints what failed; the exit code is
// 1 if anything did. test_formulas.cpp has the rest of the folder.
#include "cpu/lane_sums.hpp"
#include "math/harmonics.hpp"
#include "math/projection.hpp"
#include "tests/check.hpp"

namespace {

using namespace dyngs;
using namespace check;

Quat<double> quat(const Values& v, int at = 0) { return {v[at], v[at + 1], v[at + 2], v[at + 3]}; }
Values values(const Quat<double>& q) { return {q.w, q.x, q.y, q.z}; }

Values values(const Mat3<double>& r) {
  Values v;
  for (const auto& row : r.m) v.insert(v.end(), row, row + 3);
  return v;
}

void test_normalize() {
  for (double size : {1.0, 1e-3, 1e3}) {
    Values x = uniforms(4, -1, 1);
    for (double& e : x) e *= size;
    const auto f = [](const Values& v) {
      double inv;
      return values(normalize(quat(v), inv));
    };
    double inv;
    const Quat<double> unit = normalize(quat(x), inv);
    const Values g = uniforms(4, -1, 1);
    // in the variable x / size, so that the steps of the differences fit
    Values scaled = x, gradient = values(normalize_vjp(unit, inv, quat(g)));
    for (double& e : scaled) e /= size;
    for (double& e : gradient) e *= size;
    const auto of_scaled = [&](Values v) {
      for (double& e : v) e *= size;
      return f(v);
    };
    expect_vjp("normalize_vjp", of_scaled, scaled, g, gradient);
  }
}

void test_normalize_extremes() {
  for (double size : {5e-324, 1e-310, 1e-30, 1e30, 1e300}) {
    double inv;
    const Quat<double> q = normalize(Quat<double>{size, 0, -size, 0}, inv);
    expect_near("normalize w", q.w, std::sqrt(0.5), 1e-15);
    expect_near("normalize y", q.y, -std::sqrt(0.5), 1e-15);
    expect_near("normalize slope is bounded", inv <= 1e12, 1, 0);
  }
  const double nan = std::numeric_limits<double>::quiet_NaN();
  for (double zero : {0.0, -0.0, nan}) {
    double inv;
    const Quat<double> q = normalize(Quat<double>{zero, zero, zero, zero}, inv);
    expect_near("zero quaternion is the identity", q.w == 1 && q.x == 0 && q.y == 0 && q.z == 0 && inv == 0, 1, 0);
  }
}

void test_rotation_matrix() {
  const Values x = uniforms(4, -1, 1), g = uniforms(9, -1, 1);
  const auto f = [](const Values& v) { return values(rotation_matrix(quat(v))); };
  Mat3<double> cotangent;
  for (int i = 0; i < 9; ++i) cotangent.m[i / 3][i % 3] = g[i];
  expect_vjp("rotation_matrix_vjp", f, x, g, values(rotation_matrix_vjp(quat(x), cotangent)));
}

// Inputs of project() in a row: centre in the camera 0-2, quaternion 3-6, scales 7-9, camera rotation 10-18,
// fx, fy, cx, cy 19-22.
struct Setup {
  Pinhole<double> camera;
  Vec3<double> center, scale;
  Quat<double> unit;
};

Setup unpack(const Values& v) {
  Setup s;
  s.camera = {{}, {0, 0, 0}, v[19], v[20], v[21], v[22], 320, 240};
  for (int i = 0; i < 9; ++i) s.camera.rotation.m[i / 3][i % 3] = v[10 + i];
  s.center = {v[0], v[1], v[2]}, s.unit = quat(v, 3), s.scale = {v[7], v[8], v[9]};
  return s;
}

Values random_setup() {
  double inv;
  const Values turn = values(rotation_matrix(normalize(quat(uniforms(4, -1, 1)), inv)));
  const double z = uniform(1, 4);
  Values v{uniform(-0.5, 0.5) * z, uniform(-0.5, 0.5) * z, z};  // inside the clamp
  for (double e : values(normalize(quat(uniforms(4, -1, 1)), inv))) v.push_back(e);
  for (double e : uniforms(3, 0.05, 0.6)) v.push_back(e);
  v.insert(v.end(), turn.begin(), turn.end());
  v.insert(v.end(), {310, 295, 160, 125});
  return v;
}

Splat<double> splat_of(const Values& v, double eps, ProjectionState<double>& state) {
  const Setup s = unpack(v);
  return project(s.camera, s.center, s.unit, s.scale, eps, state);
}

void test_project_vjp(double eps, bool outside) {
  Values x = random_setup();
  if (outside) x[0] = 3 * x[2], x[1] = -3 * x[2];  // x/z and y/z beyond the clamp
  const auto f = [&](const Values& v) {
    ProjectionState<double> state;
    const Splat<double> s = splat_of(v, eps, state);
    return Values{s.x, s.y, s.depth, s.conic.u, s.conic.w, s.conic.v, s.conic.compensation};
  };
  const Values g = uniforms(7, -1, 1);
  const Setup s = unpack(x);
  ProjectionState<double> state;
  const Splat<double> splat = splat_of(x, eps, state);
  expect_near("the clamp is as wanted", state.free_x, !outside, 0);
  const SplatGrad<double> cotangent{g[0], g[1], g[2], {g[3], g[4], g[5], g[6]}};
  const ProjectionGrad<double> d = project_vjp(s.camera, s.unit, s.scale, eps, state, splat, cotangent);
  Values gradient{d.cam.x, d.cam.y, d.cam.z};
  for (double e : values(d.unit)) gradient.push_back(e);
  for (double e : {d.scale.x, d.scale.y, d.scale.z}) gradient.push_back(e);
  for (const auto& row : d.view) gradient.insert(gradient.end(), row, row + 3);
  const IntrinsicsGrad<double> lens = intrinsics_vjp(state, cotangent, d);
  gradient.insert(gradient.end(), {lens.fx, lens.fy, lens.cx, lens.cy});
  expect_vjp("project_vjp eps " + std::to_string(eps) + (outside ? " clamped" : ""), f, x, g, gradient);
}

// The conic's factor against a covariance inverted in long double.
void test_project_forward() {
  const double eps = 0.3;
  const Values x = random_setup();
  ProjectionState<double> state;
  const Conic<double> s = splat_of(x, eps, state).conic;
  const CovarianceState<double>& st = state.shape;
  long double xx = 0, xy = 0, yy = 0;
  for (int k = 0; k < 3; ++k) {
    xx += static_cast<long double>(st.m[0][k]) * st.m[0][k], yy += static_cast<long double>(st.m[1][k]) * st.m[1][k];
    xy += static_cast<long double>(st.m[0][k]) * st.m[1][k];
  }
  const long double bare = xx * yy - xy * xy, det = (xx + eps) * (yy + eps) - xy * xy;
  expect_near("conic a", s.u * s.u, static_cast<double>((yy + eps) / det), 1e-12);
  expect_near("conic b", s.u * s.w, static_cast<double>(-xy / det), 1e-12);
  expect_near("conic c", s.w * s.w + s.v * s.v, static_cast<double>((xx + eps) / det), 1e-12);
  expect_near("compensation", s.compensation, static_cast<double>(std::sqrt(bare / det)), 1e-12);
  expect_near("variance x", s.var_x, static_cast<double>(xx + eps), 1e-12);
  expect_near("variance y", s.var_y, static_cast<double>(yy + eps), 1e-12);
}

// A needle of 1e8:1 in float: the width across it is eps to a few ulps, though det C = 1e11 * eps nearly cancels.
void test_needle() {
  for (int trial = 0; trial < 20; ++trial) {
    const Pinhole<float> camera{{{{1, 0, 0}, {0, 1, 0}, {0, 0, 1}}}, {0, 0, 0}, 300, 300, 160, 120, 320, 240};
    const double angle = uniform(0.1, 3.0);
    const auto w = static_cast<float>(std::cos(angle / 2)), z = static_cast<float>(std::sin(angle / 2));
    ProjectionState<float> state;
    const Vec3<float> center{0, 0, 1}, scale{1e3f, 1e-5f, 1e-5f};
    const Conic<float> s = project(camera, center, Quat<float>{w, 0, 0, z}, scale, 0.3f, state).conic;
    const double narrow = std::hypot(s.u, std::hypot(s.w, s.v));     // 1 / the small standard deviation
    expect_near("needle", narrow * std::sqrt(0.3 + 9e-6), 1, 1e-6);  // 9e-6: 300 px times 1e-5, squared
  }
}

void test_harmonics() {
  for (int degree = 0; degree <= 4; ++degree) {
    const int terms = (degree + 1) * (degree + 1);
    const Values x = uniforms(3, -1, 1), g = uniforms(terms, -1, 1);
    const auto f = [&](const Values& v) {
      Values basis(terms);
      sh_basis(degree, v[0], v[1], v[2], basis.data());
      return basis;
    };
    Values gradient(3);
    sh_basis_vjp(degree, x[0], x[1], x[2], g.data(), gradient[0], gradient[1], gradient[2]);
    expect_vjp("sh_basis_vjp degree " + std::to_string(degree), f, x, g, gradient);
  }
}

template <class S>
void test_packets(double tolerance) {
  const double eps = 0.3;
  Pinhole<S> camera{{}, {0, 0, 0}, 310, 295, 160, 125, 320, 240};
  Packet<S> lanes[10];
  std::vector<Values> rows;
  const Values first = random_setup();
  for (int i = 0; i < 9; ++i) camera.rotation.m[i / 3][i % 3] = static_cast<S>(first[10 + i]);
  for (int lane = 0; lane < kLanes; ++lane) {
    rows.push_back(random_setup());
    std::copy(first.begin() + 10, first.end(), rows.back().begin() + 10);
    for (int i = 0; i < 10; ++i) lanes[i][lane] = static_cast<S>(rows.back()[i]);
  }
  ProjectionState<Packet<S>> state;
  const auto splat = project(camera, Vec3<Packet<S>>{lanes[0], lanes[1], lanes[2]},
                             Quat<Packet<S>>{lanes[3], lanes[4], lanes[5], lanes[6]},
                             Vec3<Packet<S>>{lanes[7], lanes[8], lanes[9]}, static_cast<S>(eps), state);
  for (int lane = 0; lane < kLanes; ++lane) {
    ProjectionState<double> scalar_state;
    const Splat<double> scalar = splat_of(rows[lane], eps, scalar_state);
    expect_near("packet x", splat.x[lane], scalar.x, tolerance);
    expect_near("packet u", splat.conic.u[lane], scalar.conic.u, tolerance);
    expect_near("packet w", splat.conic.w[lane], scalar.conic.w, tolerance);
    expect_near("packet v", splat.conic.v[lane], scalar.conic.v, tolerance);
    expect_near("packet compensation", splat.conic.compensation[lane], scalar.conic.compensation, tolerance);
  }
}

void test_exp2() {
  for (int i = 0; i < 2000; ++i) {
    Packet<float> x;
    for (int lane = 0; lane < kLanes; ++lane) x[lane] = static_cast<float>(uniform(-126, 0));
    const Packet<float> y = exp2(x);
    for (int lane = 0; lane < kLanes; ++lane)
      expect_near("exp2", y[lane] / std::exp2(static_cast<double>(x[lane])), 1, 2.5e-7);
  }
  expect_near("exp2 of zero", exp2(Packet<float>(0.0f))[0], 1, 2.5e-7);
  const float tiny = exp2(Packet<float>(-std::numeric_limits<float>::infinity()))[0];
  expect_near("exp2 far below is small, not NaN", tiny >= 0 && tiny < 2e-38f, 1, 0);
}

// Integers, whose sums are exact: each number belongs to its packet and lane.
template <class S, int kCount>
void test_lane_sums() {
  Packet<S> x[kCount];
  S sums[kCount];
  for (int i = 0; i < kCount; ++i)
    for (int lane = 0; lane < kLanes; ++lane) x[i][lane] = static_cast<S>(1000 * i + (lane * lane * 7 + i) % 31);
  lane_sums(x, sums);
  for (int i = 0; i < kCount; ++i) expect_near("sum of lanes " + std::to_string(i), sums[i], horizontal_sum(x[i]), 0);
}

// Selections and comparisons, lane by lane, of which each is of its own half or quarter of a packet on older processors.
template <class S>
void test_masks() {
  for (uint32_t bits : {0u, 1u, 0x8000u, 0x0180u, 0x7ffeu, 0xffffu}) {
    Packet<S> x;
    for (int lane = 0; lane < kLanes; ++lane) x[lane] = bits >> lane & 1 ? S(lane) : S(-1 - lane);
    const PacketMask<S> mask = x >= Packet<S>(S(0));
    expect(to_bits(mask) == bits && to_bits(!mask) == (~bits & 0xffffu), "bits of a mask");
    expect(any(mask) == (bits != 0) && any(!mask) == (bits != 0xffffu), "any lane of a mask");
    const Packet<S> chosen = select(mask, x, -x);
    for (int lane = 0; lane < kLanes; ++lane)
      expect_near("lane of a selection", chosen[lane], bits >> lane & 1 ? lane : lane + 1, 0);
  }
}

}  // namespace

int main() {
  skip_unless_supported();
  for (int trial = 0; trial < 20; ++trial) {
    test_normalize();
    test_rotation_matrix();
    test_harmonics();
    test_project_forward();
    for (double eps : {0.3, 0.0, 10.0}) test_project_vjp(eps, trial % 4 == 3);
  }
  test_normalize_extremes();
  test_needle();
  test_packets<double>(1e-13);  // same formulas, other order of fused multiply-adds
  test_packets<float>(2e-5);    // float rounding, 6e-8, times the condition of the formulas
  test_exp2();
  test_lane_sums<float, 1>(), test_lane_sums<float, 7>(), test_lane_sums<float, 9>(), test_lane_sums<float, 16>();
  test_lane_sums<double, 9>();
  test_masks<float>(), test_masks<double>();
  return report();
}
