// Blending, ellipses, skinning, posing, slicing, planes, SSIM, Adam and colour inputs of csrc/math, on scalars: every hand-derived vjp against
// central differences in double, the rest against plain formulas.
#include "math/adam.hpp"
#include "math/blend.hpp"
#include "math/ellipse.hpp"
#include "math/planes.hpp"
#include "math/posing.hpp"
#include "math/shading.hpp"
#include "math/skinning.hpp"
#include "math/slicing.hpp"
#include "math/ssim.hpp"
#include "tests/check.hpp"

#include "cpu/simd.hpp"

namespace {

using namespace dyngs;
using namespace check;

Vec3<double> vec(const Values& v, size_t at) { return {v[at], v[at + 1], v[at + 2]}; }
void append(Values& to, const Vec3<double>& v) {
  for (double e : {v.x, v.y, v.z}) to.push_back(e);
}

void test_vectors() {
  const Values x = uniforms(3, 0.2, 1), g = uniforms(3, -1, 1);
  const auto unit = [](const Values& v) {
    double inv_norm;
    Values out;
    append(out, normalize(vec(v, 0), inv_norm));
    return out;
  };
  double inv_norm;
  const Vec3<double> n = normalize(vec(x, 0), inv_norm);
  Values gradient;
  append(gradient, normalize_vjp(n, inv_norm, vec(g, 0)));
  expect_vjp("normalize_vjp of a vector", unit, x, g, gradient);
  double unused;
  const Quat<double> a = normalize(Quat<double>{x[0], g[0], g[1], g[2]}, unused);
  const Quat<double> b = normalize(Quat<double>{g[1], x[2], x[0], x[1]}, unused);
  const Vec3<double> v = vec(g, 0), once = rotation_matrix(a * b) * v;
  const Vec3<double> twice = rotation_matrix(a) * (rotation_matrix(b) * v), moved = v + rotation_minus_identity(a) * v;
  const Vec3<double> back = transposed_times(rotation_matrix(a), moved);
  for (int i = 0; i < 3; ++i) {
    expect_near("product of quaternions", once[i], twice[i], 1e-14);
    expect_near("rotation minus identity, turned back", back[i], v[i], 1e-14);
  }
}

// Blending ------------------------------------------------------------------------------------------------------------

constexpr int kDepth = 4, kPerGaussian = 7;  // mean, u w v, opacity, shade
constexpr double kAlphaMax = 0.9, kBackground = 0.3;
constexpr double kPixelX[] = {10.5, 12.5}, kPixelY[] = {20.5, 19.5};

BlendGaussian<double> gaussian_at(const Values& v, int k) {
  const double* p = v.data() + k * kPerGaussian;
  return blend_gaussian(p, p + 2, p[5]);
}

double raw_alpha(const Values& v, int k, int pixel) {
  const BlendGaussian<double> g = gaussian_at(v, k);
  const double x = kPixelX[pixel] - kPixelX[0], y = kPixelY[pixel] - kPixelY[0];
  return dyngs::exp2(log2_alpha(g, g.x - kPixelX[0], g.y - kPixelY[0], x, y));
}

// Light of two pixels, blended front to back as the textbook has it.
Values plain_light(const Values& v) {
  Values light;
  for (int pixel = 0; pixel < 2; ++pixel) {
    double sum = 0, left = 1;
    for (int k = 0; k < kDepth; ++k) {
      const double* p = v.data() + k * kPerGaussian;
      const double dx = p[0] - kPixelX[pixel], dy = p[1] - kPixelY[pixel], a = p[2] * dx + p[3] * dy, b = p[4] * dy;
      const double alpha = std::min(kAlphaMax, p[5] * std::exp(-0.5 * (a * a + b * b)));
      sum += left * alpha * p[6], left *= 1 - alpha;
    }
    light.push_back(sum + left * kBackground);
  }
  return light;
}

// The same by the steps of math/blend.hpp, and the gradients of its backward steps for cotangents g of the two pixels.
struct Blended {
  Values light, shades;     // (2), (kDepth) gradients by the shades
  double p[kDepth][2];      // gradients by log alpha
  double slope[kDepth][2];  // d light / d alpha, from front to back
};

Blended blend(const Values& v, const Values& g) {
  Blended out{{}, Values(kDepth), {}, {}};
  for (int pixel = 0; pixel < 2; ++pixel) {
    double left = 1, light = 0, raw[kDepth], alpha[kDepth], before[kDepth];
    for (int k = 0; k < kDepth; ++k) {
      raw[k] = raw_alpha(v, k, pixel), alpha[k] = clamped_alpha(raw[k], kAlphaMax, true), before[k] = left;
      const BlendStep<double> step = blend_step(alpha[k], left, 0.0);
      light += step.weight * v[k * kPerGaussian + 6], left = step.transmittance;
    }
    out.light.push_back(light + left * kBackground);
    double reaching = out.light[pixel];
    BlendBehind<double> behind{left, g[pixel] * kBackground};
    for (int k = kDepth - 1; k >= 0; --k) {
      const BlendGrad<double> grad = blend_vjp(raw[k], alpha[k], kAlphaMax, g[pixel] * v[k * kPerGaussian + 6], behind);
      out.p[k][pixel] = grad.by_log_alpha, out.shades[k] += g[pixel] * grad.weight;
    }
    expect_near("transmittance is restored", behind.transmittance, 1, 1e-13);
    for (int k = 0; k < kDepth; ++k) {
      const double shade = v[k * kPerGaussian + 6], own = alpha[k] * before[k] * shade;
      out.slope[k][pixel] = slope_by_alpha(alpha[k], before[k], shade, own, reaching);
      reaching -= own;
    }
  }
  return out;
}

// Moments of the two pixels about an anchor, sums about a third point, and the splat's gradients: as the tiles do it.
BlendSplatGrad<double> gradients_of(const Values& v, int k, const double (&p)[2]) {
  const double* mean = v.data() + k * kPerGaussian;
  double moments[kBlendSums] = {}, about[kBlendSums], sums[kBlendSums];
  for (int pixel = 0; pixel < 2; ++pixel) {
    const double x = kPixelX[pixel] - kPixelX[0], y = kPixelY[pixel] - kPixelY[0];
    const double powers[] = {1, x, y, x * x, x * y, y * y};
    for (int m = 0; m < kBlendSums; ++m) moments[m] += p[pixel] * powers[m];
  }
  const Vec2<double> anchor{13, 17}, origin{8, 30};
  moments_about(moments, anchor.x - kPixelX[0], anchor.y - kPixelY[0], about);
  blend_sums(about, mean[2], mean[3], mean[4], {mean[0] - anchor.x, mean[1] - anchor.y},
             {origin.x - anchor.x, origin.y - anchor.y}, sums);
  return splat_grad<double>(sums, mean[2], mean[3], mean[4], mean[5], {mean[0] - origin.x, mean[1] - origin.y});
}

void test_blend_vjp() {
  Values v;
  for (int k = 0; k < kDepth; ++k)
    for (double e : {uniform(9, 14), uniform(17, 22), uniform(0.2, 0.6), uniform(-0.2, 0.2), uniform(0.2, 0.6),
                     k == 1 ? 5.0 : uniform(0.2, 0.8), uniform(0, 1)})
      v.push_back(e);
  v[7] = 10.6, v[8] = 20.4;  // the second Gaussian's alpha is clamped at the first pixel
  const Values g = uniforms(2, -1, 1);
  const Blended out = blend(v, g);
  expect_close("blended light", out.light, plain_light(v), 1e-13);
  Values gradient;
  for (int k = 0; k < kDepth; ++k) {
    const BlendSplatGrad<double> s = gradients_of(v, k, out.p[k]);
    for (double e : {s.mean.x, s.mean.y, s.u, s.w, s.v, s.opacity, out.shades[k]}) gradient.push_back(e);
    double slope_x = 0, slope_y = 0;
    for (int pixel = 0; pixel < 2; ++pixel) {
      const double* at = v.data() + k * kPerGaussian;
      const double dx = at[0] - kPixelX[pixel], dy = at[1] - kPixelY[pixel];
      const Vec2<double> z{at[2] * dx + at[3] * dy, at[4] * dy};
      const Vec2<double> slope = slope_by_mean(out.p[k][pixel], at[2], at[3], at[4], z);
      slope_x -= slope.x, slope_y -= slope.y;
      const double raw = raw_alpha(v, k, pixel);
      if (raw < kAlphaMax) expect_near("slope by alpha", out.slope[k][pixel] * raw * g[pixel], out.p[k][pixel], 1e-13);
    }
    expect_near("slope by mean x", slope_x, s.mean.x, 1e-13), expect_near("slope by mean y", slope_y, s.mean.y, 1e-13);
  }
  expect(out.p[1][0] == 0, "the clamp of alpha stops the gradient");
  expect_vjp("blend_vjp", plain_light, v, g, gradient);
}

// A pixel that would become too dark is left as it was; lanes agree with scalars.
void test_blend_packets() {
  Packet<double> alpha, before;
  for (int i = 0; i < kLanes; ++i) alpha[i] = uniform(0, 0.99), before[i] = uniform(0.05, 1);
  BlendStep<Packet<double>> step = blend_step(alpha, before, Packet<double>(0.1));
  leave_full(before, step);
  BlendBehind<Packet<double>> behind{step.transmittance, Packet<double>(0.4)};
  const auto grad = blend_vjp(alpha, alpha, Packet<double>(0.9), Packet<double>(0.7), behind);
  for (int i = 0; i < kLanes; ++i) {
    BlendStep<double> one = blend_step(alpha[i], before[i], 0.1);
    leave_full(before[i], one);
    expect_near("weight of a lane", step.weight[i], one.weight, 0);
    expect_near("transmittance of a lane", step.transmittance[i], one.transmittance, 1e-15);
    if (one.full) expect(one.weight == 0 && one.transmittance == before[i], "a full pixel takes no more");
    BlendBehind<double> one_behind{one.transmittance, 0.4};
    const BlendGrad<double> one_grad = blend_vjp(alpha[i], alpha[i], 0.9, 0.7, one_behind);
    expect_near("gradient of a lane", grad.by_log_alpha[i], one_grad.by_log_alpha, 1e-15);
    expect_near("light behind a lane", behind.light[i], one_behind.light, 1e-15);
  }
}

void test_ellipse() {
  const double u = uniform(0.1, 0.4), w = uniform(-0.2, 0.2), v = uniform(0.1, 0.4);
  const Ellipse<double> e = visible_ellipse(3.0, 4.0, u, w, v, 0.8, 1 / 255.0);
  double right = -1e9, top = -1e9, least = 1e9;
  for (int i = 0; i < 20000; ++i) {
    const double angle = i * 3.14159265358979 / 10000, b = std::sqrt(e.t) * std::sin(angle), dy = b / v;
    right = std::max(right, 3 + (std::sqrt(e.t) * std::cos(angle) - w * dy) / u), top = std::max(top, dy);
    const double x = -1 + 3 * (i % 200) / 199.0, y = 0.5 + 2 * (i / 200) / 99.0;
    least = std::min(least, (u * x + w * y) * (u * x + w * y) + v * y * v * y);
  }
  expect_near("the ellipse's right end", reach(e, -100.0, 100.0, 1.0), right, 1e-6);
  expect_near("the ellipse's top", e.half_height, top, 1e-6);
  expect_near("least in a box", least_in_box(u, w, v, -1.0, 0.5, 2.0, 2.5), least, 1e-3);
  const PixelRange<double> range = pixels_between(2.4, 7.6, 100), all = pixels_between(-5.0, 1e9, 100);
  expect(range.begin == 2 && range.end == 8 && all.begin == 0 && all.end == 100, "pixels with their centre between");
}

// Deformation -------------------------------------------------------------------------------------------------------

void test_skinning() {
  const Values x = uniforms(10, -1, 1), g = uniforms(3, -1, 1);  // quaternion, shift, arm
  const auto move = [](const Values& v) {
    const Mat3<double> r = turn_of(load_quat(v.data()));
    Vec3<double> columns[3];
    for (int j = 0; j < 3; ++j) columns[j] = {r.m[0][j], r.m[1][j], r.m[2][j]};
    Values out;
    append(out, moved_by(columns, vec(v, 4), vec(v, 7)));
    return out;
  };
  const Mat3<double> r = turn_of(load_quat(x.data()));
  const Vec3<double> rows[3] = {load_vec3(r.m[0]), load_vec3(r.m[1]), load_vec3(r.m[2])};
  Vec3<double> by_columns[3] = {}, by_shift{}, by_point{};
  moved_by_vjp(rows, vec(x, 7), vec(g, 0), by_columns, by_shift, by_point);
  Mat3<double> by_turn;
  for (int i = 0; i < 3; ++i)
    for (int j = 0; j < 3; ++j) by_turn.m[i][j] = by_columns[j][i];
  const Quat<double> q = turn_vjp(load_quat(x.data()), by_turn);
  Values gradient{q.w, q.x, q.y, q.z};
  append(gradient, by_shift), append(gradient, by_point);
  expect_vjp("moved_by_vjp", move, x, g, gradient);
  const Vec3<double> arm = vec(x, 4);
  expect_near("weight of a node", std::exp2(weight_exponent(arm, weight_decay<double>(0.7))),
              std::exp(-dot(arm, arm) / (2 * 0.7 * 0.7)), 1e-14);
  expect(std::isnan(turn_of(Quat<double>{1, kNaN<double>, 0, 0}).m[2][2]), "NaN stays NaN");
  expect(weight_exponent(Vec3<double>{1e200, 0, 0}, weight_decay<double>(1e-200)) == -kLargest<double>, "no infinity");
}

// Inputs in a row: T 0-8, quaternion 9-12, log scales 13-15.
Mat3<double> linear_of(const Values& v) { return {{{v[0], v[1], v[2]}, {v[3], v[4], v[5]}, {v[6], v[7], v[8]}}}; }
RestShape<double> shape_of(const Values& v) {
  return rest_shape<double>(load_quat(v.data() + 9), {v[13], v[14], v[15]});
}

Values gradient_of(const Values& v, const Values& g) {
  const MovedShape<double> moved = move_shape(linear_of(v), shape_of(v));
  const MovedShapeGrad<double> by =
      move_shape_vjp<double>(linear_of(v), shape_of(v), moved, load_quat(g.data()), {g[4], g[5], g[6]});
  Values gradient;
  for (const auto& row : by.linear.m) gradient.insert(gradient.end(), row, row + 3);
  gradient.insert(gradient.end(), {by.quat.w, by.quat.x, by.quat.y, by.quat.z});
  gradient.insert(gradient.end(), by.log_scales, by.log_scales + 3);
  return gradient;
}

// M M^T of R diag(exp(log scales)).
Mat3<double> covariance_of(const Quat<double>& q, const double (&log_scales)[3]) {
  Mat3<double> half = rotation_matrix(q);
  for (auto& row : half.m)
    for (int k = 0; k < 3; ++k) row[k] *= std::exp(log_scales[k]);
  return product(half, transposed(half));
}

// T S T^T to `tolerance` of |T|^2 |S|.
void expect_moved(const std::string& what, const Values& v, double tolerance) {
  const Mat3<double> linear = linear_of(v);
  const Mat3<double> still = covariance_of(shape_of(v).unit, {v[13], v[14], v[15]});
  const MovedShape<double> moved = move_shape(linear, shape_of(v));
  const Mat3<double> found = covariance_of(moved.quat, moved.log_scales);
  const Mat3<double> wanted = product(product(linear, still), transposed(linear));
  double error = 0, square = 0, size = 0;
  for (int i = 0; i < 9; ++i) {
    error = std::max(error, std::abs(found.m[i / 3][i % 3] - wanted.m[i / 3][i % 3]));
    square += linear.m[i / 3][i % 3] * linear.m[i / 3][i % 3], size += still.m[i / 3][i % 3] * still.m[i / 3][i % 3];
  }
  expect(error <= tolerance * square * std::sqrt(size) + 1e-250, what);  // what vanishes is not quite zero
}

void test_posing() {
  Values v = uniforms(9, -1, 1), g = uniforms(7, -1, 1);
  for (double x : uniforms(4, 0.3, 1)) v.push_back(x);  // not short: slopes grow with its inverse
  for (double x : uniforms(3, -2, 0.5)) v.push_back(x);
  const auto f = [](const Values& x) {
    const MovedShape<double> m = move_shape(linear_of(x), shape_of(x));
    return Values{m.quat.w, m.quat.x, m.quat.y, m.quat.z, m.log_scales[0], m.log_scales[1], m.log_scales[2]};
  };
  expect_moved("a moved covariance", v, 1e-14);
  expect_vjp("move_shape_vjp", f, v, g, gradient_of(v, g));
  Mat3<double> by_linear{};
  const Vec3<double> by_point = moved_point_vjp(linear_of(v), vec(v, 9), vec(g, 0), by_linear);
  Values gradient(by_linear.m[0], by_linear.m[0] + 9);
  append(gradient, by_point), append(gradient, vec(g, 0));
  const auto point = [](const Values& x) {
    Values out;
    append(out, moved_point(linear_of(x), vec(x, 12), vec(x, 9)));
    return out;
  };
  expect_vjp("moved_point_vjp", point, Values(v.begin(), v.begin() + 15), Values(g.begin(), g.begin() + 3), gradient);
  // Maps that flatten: to a plane, to a line, to nothing. Gradients stay finite, for balls and needles, too.
  for (const Values& kept :
       {Values{0, 1, 1}, {1, 0, 1}, {1, 1, 0}, {1, 0, 0}, {0, 1, 0}, {0, 0, 1}, {0, 0, 0}, {1, 1, 1}})
    for (const double logs : {0.0, -2.0, -80.0}) {
      Values flat{kept[0], 0, 0, 0, kept[1], 0, 0, 0, kept[2], 1, 0, 0, 0, 0, logs, logs};
      expect_moved("a flattened covariance", flat, 2e-14);
      for (double x : gradient_of(flat, g)) expect(std::isfinite(x), "finite gradients of posing");
    }
  v[14] = v[13], v[15] = kNaN<double>;
  const MovedShape<double> lost = move_shape(linear_of(v), shape_of(v));
  expect(std::isnan(lost.log_scales[0] + lost.log_scales[1] + lost.log_scales[2]), "NaN in a scale stays");
}

// Inputs in a row: mean 0-2, time 3, quaternions 4-11, log scales 12-15, logit 16.
SpaceTime<double> space_time_of(const Values& v) {
  return space_time<double>(load_quat(v.data() + 4), load_quat(v.data() + 8), {v[12], v[13], v[14], v[15]});
}

Values slice_of(const Values& v, double time) {
  const SpaceTime<double> f = space_time_of(v);
  const SlicedShape<double> s = sliced_shape(f);
  Values out;
  append(out, sliced_mean(vec(v, 0), f.velocity, time - v[3]));
  out.insert(out.end(), {s.quat.w, s.quat.x, s.quat.y, s.quat.z});
  out.insert(out.end(), s.log_scales, s.log_scales + 3);
  out.push_back(visibility(f, time - v[3], v[16], kLargestExponent).logit);
  return out;
}

Values slice_gradient(const Values& v, double time, const Values& g) {
  const SpaceTime<double> f = space_time_of(v);
  const SliceGrad<double> by{vec(g, 0), load_quat(g.data() + 3), {g[7], g[8], g[9]}, g[10]};
  const SpaceTimeGrad<double> found = slice_vjp(f, sliced_shape(f), time - v[3], v[16], kLargestExponent, by);
  Values gradient;
  append(gradient, found.mean);
  gradient.push_back(found.time);
  for (const Quat<double>& q : {found.left, found.right}) gradient.insert(gradient.end(), {q.w, q.x, q.y, q.z});
  gradient.insert(gradient.end(), found.log_scales, found.log_scales + 4);
  gradient.push_back(found.logit);
  return gradient;
}

void test_slicing() {
  Values v = uniforms(4, -0.5, 0.5), g = uniforms(11, -1, 1);
  for (double x : uniforms(8, 0.3, 1)) v.push_back(x);
  v.insert(v.end(), {uniform(-1.2, -1), uniform(-0.6, -0.4), uniform(0, 0.2), uniform(-0.5, 0.5), uniform(-2, 2)});
  expect_vjp("slice_vjp", [](const Values& x) { return slice_of(x, 0.6); }, v, g, slice_gradient(v, 0.6, g));
  // A still Gaussian is its own slice, however long it lives: spans of 1e-6 to 1e6 at scales near 1.
  for (const double span : {-13.8, 0.0, 13.8}) {
    Values still = v;
    for (int k = 0; k < 4; ++k) still[8 + k] = k == 0 ? v[4] : -v[4 + k];
    still[15] = span;
    const SpaceTime<double> f = space_time_of(still);
    const SlicedShape<double> s = sliced_shape(f);
    expect(norm(f.velocity) == 0, "a still Gaussian does not move");
    expect_near("its life", log_deviation(f), span, 1e-14);
    const Mat3<double> found = covariance_of(s.quat, s.log_scales);
    const Mat3<double> wanted = covariance_of(f.left, {v[12], v[13], v[14]});
    for (int i = 0; i < 9; ++i) expect_near("a still Gaussian", found.m[i / 3][i % 3], wanted.m[i / 3][i % 3], 1e-14);
  }
  // Equal axes, vanishing ones, and a vanishing life.
  for (const double log_scale : {0.0, -60.0, -1000.0})
    for (int which = 12; which < 16; ++which) {
      Values flat = v;
      flat[12] = flat[13] = flat[14] = flat[15] = 0;
      flat[which] = log_scale;
      for (double x : slice_of(flat, flat[3])) expect(std::isfinite(x), "finite slices");
      for (double x : slice_gradient(flat, flat[3], g)) expect(std::isfinite(x), "finite gradients of slices");
    }
  for (double x : {1e-12, 1e-3, 0.349, 0.351, 20.0})
    expect_near("1 - exp(-x)", one_minus_exp(x, std::exp(-x)) / -std::expm1(-x), 1, 1e-15);
  for (int at = 0; at < 17; ++at) {
    Values lost = v;
    lost[at] = kNaN<double>;
    double sum = 0;
    for (double x : slice_of(lost, 0.6)) sum += x;
    expect(std::isnan(sum), "NaN stays in a slice");
  }
}

// 12 samples of three planes, 6 of three lines, then three coordinates in samples.
Values plane_feature(const Values& v) {
  constexpr int kFast[] = {0, 0, 1}, kSlow[] = {1, 2, 2};
  double plane[3], line[3];
  for (int p = 0; p < 3; ++p) {
    const double* s = v.data() + 4 * p;
    plane[p] = bilinear(s[0], s[1], s[2], s[3], v[18 + kFast[p]], v[18 + kSlow[p]]);
    line[p] = lerp(v[12 + 2 * p], v[13 + 2 * p], v[18 + p]);
  }
  return {plane_product(plane, line)};
}

void test_planes() {
  constexpr int kFast[] = {0, 0, 1}, kSlow[] = {1, 2, 2};
  Values v = uniforms(18, 0.5, 1.5), gradient(21);
  for (double x : uniforms(3, 0.1, 0.9)) v.push_back(x);
  PlaneValue<double> plane[3];
  double line[3], by_line[3], g_plane[3], g_line[3], g[3];
  for (int p = 0; p < 3; ++p) {
    const double* s = v.data() + 4 * p;
    plane[p] = bilinear_slopes(s[0], s[1], s[2], s[3], v[18 + kFast[p]], v[18 + kSlow[p]]);
    line[p] = lerp(v[12 + 2 * p], v[13 + 2 * p], v[18 + p]), by_line[p] = v[13 + 2 * p] - v[12 + 2 * p];
  }
  plane_product_vjp(plane, line, 0.7, g_plane, g_line);
  coordinate_vjp(plane, by_line, g_plane, g_line, g);
  for (int p = 0; p < 3; ++p) {
    double weight[4];
    bilinear_weights(v[18 + kFast[p]], v[18 + kSlow[p]], weight);
    for (int k = 0; k < 4; ++k) gradient[4 * p + k] = g_plane[p] * weight[k];
    gradient[12 + 2 * p] = g_line[p] * (1 - v[18 + p]), gradient[13 + 2 * p] = g_line[p] * v[18 + p];
    gradient[18 + p] = g[p];
  }
  expect_vjp("plane_product_vjp", plane_feature, v, {0.7}, gradient);
}

void test_plane_cells() {
  for (double u : {-0.9, -0.1, 0.35, 0.98}) {
    const auto place = [](const Values& x) {
      const Cell<double> cell = locate(x[0], 12);
      return Values{cell.index + cell.frac};
    };
    expect_vjp("locate_vjp", place, {u}, {0.6}, {locate_vjp(u, 12, 0.6)});
  }
  expect(locate(1.5, 12).index == 10 && locate(1.5, 12).frac == 1, "coordinates outside are clamped");
  expect(locate(kNaN<double>, 12).index == 0 && std::isnan(locate(kNaN<double>, 12).frac), "NaN stays in the fraction");
  const TimeRows rows = time_rows(0.5, 4), last = time_rows(7.0, 4), only = time_rows(0.5, 1);
  expect(rows.first == 1 && rows.second == 2 && rows.weight == 0.5, "rows around a time");
  expect(last.first == 2 && last.second == 3 && last.weight == 1, "times outside are clamped");
  expect(only.first == 0 && only.second == 0 && only.weight == 0, "a single row");
  const Values p = uniforms(5, -1, 1);  // d of neighbours 1, 2, 3 depends on p[2]
  const auto roughness = [](const Values& x) {
    double sum = 0;
    for (int i = 1; i < 4; ++i) sum += std::pow(second_difference(x[i - 1], x[i], x[i + 1]), 2);
    return Values{sum, std::abs(x[2])};
  };
  Values d;
  for (int i = 1; i < 4; ++i) d.push_back(second_difference(p[i - 1], p[i], p[i + 1]));
  const double slope = second_difference_vjp(d[0], d[1], d[2], 2.0) + distance_vjp(p[2], 1.0);
  const auto at = [&](const Values& x) { return roughness({p[0], p[1], x[0], p[3], p[4]}); };
  expect_vjp("second_difference_vjp and distance_vjp", at, {p[2]}, {1, 1}, {slope});
}

// Colour and training -----------------------------------------------------------------------------------------------

void test_shading() {
  const Values x = uniforms(4, -1, 1), d = uniforms(3, -3, 3);
  double unused;
  const Mat3<double> r = rotation_matrix(normalize(load_quat(x.data()), unused));
  for (int axis = 0; axis < 3; ++axis) {
    double scales[] = {0, 0, 0};
    scales[axis] = -1;
    const Vec3<double> got = shortest_axis(load_quat(x.data()), scales);
    for (int i = 0; i < 3; ++i) expect_near("shortest axis", got[i], r.m[i][axis], 1e-14);
  }
  const Vec3<double> v = vec(d, 0), n = load_vec3(r.m[0]), mirrored = reflected(v, n, dot(v, n));
  expect_near("reflected, along the normal", dot(mirrored, n), -dot(v, n), 1e-13);
  expect_near("reflected, length", norm(mirrored), norm(v), 1e-13);
  const double length = norm(v);
  expect_near("contracted", norm(contracted(v)), length > 1 ? 2 - 1 / length : length, 1e-13);
}

void test_ssim() {
  const double mx = uniform(0.2, 0.8), my = uniform(0.2, 0.8), vx = uniform(0.01, 0.1), vy = uniform(0.01, 0.1);
  const double xy = uniform(-0.01, 0.01), md = mx - my, ms = mx + my;
  const Values maps{0, md * md + vx + vy - 2 * xy,
                    ms * ms + vx + vy + 2 * xy};  // a shift of both means, G(d^2), G(s^2)
  const auto ssim = [&](const Values& v) {
    return Values{1 - ssim_terms(md + v[0], ms + v[0], v[1], v[2]).dissimilarity};
  };
  const double wanted =
      (2 * mx * my + kSsimC1) * (2 * xy + kSsimC2) / ((mx * mx + my * my + kSsimC1) * (vx + vy + kSsimC2));
  expect_near("ssim", ssim(maps)[0], wanted, 1e-13);
  const SsimTerms<double> t = ssim_terms(md, ms, maps[1], maps[2]);
  expect_vjp("ssim_terms", ssim, maps, {1}, {t.grad_mean, t.grad_diff_square, t.grad_sum_square});
  expect_near("ssim_grad", ssim_grad(2.0, 3.0, 5.0, 7.0, 11.0), 5 + 2 * 2 * 7 + 2 * 3 * 11, 0);
  expect(sign(-2.0) == -1 && sign(0.0) == 0 && std::isnan(sign(kNaN<double>)), "sign");
}

void test_adam() {
  const AdamCoefficients<double> c{0.1, 0.999, 0.001, 1 / std::sqrt(1 - 0.999 * 0.999), 1e-8};
  const AdamElement<double> next = adam_update(AdamElement<double>{0.3, 0.2, 0.05}, -0.7, 0.01, c);
  const double m = 0.9 * 0.2 - 0.1 * 0.7, v = 0.999 * 0.05 + 0.001 * 0.49;
  expect_near("Adam, first moment", next.exp_avg, m, 1e-15),
      expect_near("Adam, second moment", next.exp_avg_sq, v, 1e-15);
  expect_near("Adam", next.param, 0.3 - 0.01 * m / (std::sqrt(v / (1 - 0.999 * 0.999)) + 1e-8), 1e-15);
}

}  // namespace

int main() {
  skip_unless_supported();
  for (int trial = 0; trial < 10; ++trial) {
    test_vectors(), test_blend_vjp(), test_blend_packets(), test_ellipse();
    test_skinning(), test_posing(), test_slicing(), test_planes(), test_plane_cells();
    test_shading(), test_ssim(), test_adam();
  }
  return report();
}
