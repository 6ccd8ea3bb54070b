// The kernels that move and recolour Gaussians, as a program without Python: against plain formulas in double, their
// gradients against central differences of these, float against double, many threads against one.
#include <cmath>
#include <memory>
#include <numeric>

#include "core/api.hpp"
#include "tests/check.hpp"

namespace {

using namespace dyngs;
using namespace check;
using Indices = std::vector<int64_t>;

Indices random_indices(int64_t count, int64_t below) {
  Indices v(count);
  for (int64_t& i : v) i = static_cast<int64_t>(uniform(0, static_cast<double>(below)));
  return v;
}

// Skinning ----------------------------------------------------------------------------------------------------------

struct Skin {
  int64_t nodes, points, per_point, width;
  Values positions, radii, motion, values, coords;
  Indices followed;
};

template <class S>
struct Skinning {
  std::vector<S> offset, blended, weights, g_points, g_motion, g_values;
};

template <class S>
Skinning<S> skin(const Skin& s, const Values& g_offset, const Values& g_blended, int threads) {
  const auto positions = as<S>(s.positions), radii = as<S>(s.radii), motion = as<S>(s.motion), values = as<S>(s.values);
  const auto coords = as<S>(s.coords), by_offset = as<S>(g_offset), by_blended = as<S>(g_blended);
  const SkinNodes<S> nodes{positions.data(), radii.data(), motion.data(), values.data(), s.nodes, s.width};
  const SkinPoints<S> points{coords.data(), s.followed.data(), s.points, s.per_point};
  Skinning<S> out;
  out.offset.resize(3 * s.points), out.blended.resize(s.width * s.points), out.weights.resize(s.per_point * s.points);
  out.g_points.resize(3 * s.points), out.g_motion.resize(7 * s.nodes), out.g_values.resize(s.width * s.nodes);
  skinning_forward(nodes, points, Skinned<S>{out.offset.data(), out.blended.data(), out.weights.data()}, threads);
  skinning_backward(nodes, points, Skinned<const S>{by_offset.data(), by_blended.data(), out.weights.data()},
                    SkinGrads<S>{out.g_points.data(), out.g_motion.data(), out.g_values.data()}, threads);
  return out;
}

// The weights of the B nodes of point m.
Values plain_weights(const Skin& s, int64_t m) {
  Values w(s.per_point);
  double total = 0;
  for (int64_t b = 0; b < s.per_point; ++b) {
    const int64_t node = s.followed[m * s.per_point + b];
    double square = 0;
    for (int c = 0; c < 3; ++c) square += std::pow(s.coords[3 * m + c] - s.positions[3 * node + c], 2);
    total += w[b] = std::exp(-square / (2 * s.radii[node] * s.radii[node]));
  }
  for (double& x : w) x /= total;
  return w;
}

// Offset (3) and blended values of point m with given weights.
Values plain_point(const Skin& s, int64_t m, const Values& weights) {
  Values out(3 + s.width);
  for (int64_t b = 0; b < s.per_point; ++b) {
    const int64_t node = s.followed[m * s.per_point + b];
    const double* q = s.motion.data() + 7 * node + 3;
    const double norm = std::sqrt(q[0] * q[0] + q[1] * q[1] + q[2] * q[2] + q[3] * q[3]);
    const double u[3] = {q[1] / norm, q[2] / norm, q[3] / norm}, w = q[0] / norm;
    double a[3], t[3], turned[3];
    for (int c = 0; c < 3; ++c) a[c] = s.coords[3 * m + c] - s.positions[3 * node + c];
    for (int c = 0; c < 3; ++c) t[c] = 2 * (u[(c + 1) % 3] * a[(c + 2) % 3] - u[(c + 2) % 3] * a[(c + 1) % 3]);
    for (int c = 0; c < 3; ++c)
      turned[c] = w * t[c] + u[(c + 1) % 3] * t[(c + 2) % 3] - u[(c + 2) % 3] * t[(c + 1) % 3];
    for (int c = 0; c < 3; ++c) out[c] += weights[b] * (turned[c] + s.motion[7 * node + c]);
    for (int64_t k = 0; k < s.width; ++k) out[3 + k] += weights[b] * s.values[node * s.width + k];
  }
  return out;
}

void test_skinning(int64_t width) {
  Skin s{9,
         1300,
         3,
         width,
         uniforms(27, -1, 1),
         uniforms(9, 0.3, 1),
         uniforms(63, -1, 1),
         uniforms(9 * width, -1, 1),
         uniforms(3900, -1, 1),
         random_indices(3900, 9)};
  const Values g_offset = uniforms(3 * s.points, -1, 1), g_blended = uniforms(width * s.points, -1, 1);
  const auto d = skin<double>(s, g_offset, g_blended, 1);
  std::vector<Values> weights;
  Values offset, blended;
  for (int64_t m = 0; m < s.points; ++m) {
    weights.push_back(plain_weights(s, m));
    const Values out = plain_point(s, m, weights.back());
    offset.insert(offset.end(), out.begin(), out.begin() + 3),
        blended.insert(blended.end(), out.begin() + 3, out.end());
  }
  expect_close("skinning, offset", d.offset, offset, 1e-12),
      expect_close("skinning, values", d.blended, blended, 1e-12);
  const auto by = [&](Values Skin::* member) {
    return [&, member](const Values& x) {
      Skin moved = s;
      moved.*member = x;
      double sum = 0;
      for (int64_t m = 0; m < s.points; ++m) {
        const Values out = plain_point(moved, m, weights[m]);
        for (int c = 0; c < 3; ++c) sum += out[c] * g_offset[3 * m + c];
        if (member == &Skin::coords) continue;  // gradients by the points are those of the offset alone
        for (int64_t k = 0; k < width; ++k) sum += out[3 + k] * g_blended[m * width + k];
      }
      return sum;
    };
  };
  expect_gradient("skinning by points", by(&Skin::coords), s.coords, d.g_points, 1e-5, 1e-7);
  expect_gradient("skinning by motion", by(&Skin::motion), s.motion, d.g_motion, 1e-5, 1e-7, 63);
  expect_gradient("skinning by values", by(&Skin::values), s.values, d.g_values, 1e-5, 1e-7);
  const auto f = skin<float>(s, g_offset, g_blended, 1), four = skin<float>(s, g_offset, g_blended, 4);
  expect_close("float skinning", f.offset, d.offset, 1e-5), expect_close("float motion", f.g_motion, d.g_motion, 1e-4);
  expect_same_bits("skinning on 4 threads", f.offset, four.offset);
  expect_same_bits("skinning gradient on 4 threads", f.g_motion, four.g_motion);
  expect_same_bits("skinning values on 4 threads", f.g_values, four.g_values);
}

// Planes ------------------------------------------------------------------------------------------------------------

constexpr int64_t kSizes[] = {7, 12}, kTimes[] = {4, 3};

struct Grids {
  int64_t channels, points;
  double time;
  Values space[2], times[2], coords;
};

template <class S>
struct Features {
  std::vector<S> features, g_coords, g_space[2], g_time[2], p_space[2], p_time[2];
  std::vector<int32_t> order;
  double penalty;
};

constexpr PenaltyWeights kPenalty{0.3, 0.5, 0.7};

template <class S>
Features<S> features_of(const Grids& g, const Values& cotangent, int threads) {
  std::vector<S> arrays[4];
  for (int l = 0; l < 2; ++l) arrays[2 * l] = as<S>(g.space[l]), arrays[2 * l + 1] = as<S>(g.times[l]);
  const auto coords = as<S>(g.coords), g_features = as<S>(cotangent);
  std::vector<PlaneLevel<S>> levels;
  Features<S> out;
  std::vector<PlaneGrads<S>> grads, penalty_grads;
  for (int l = 0; l < 2; ++l) {
    levels.push_back({arrays[2 * l].data(), arrays[2 * l + 1].data(), kSizes[l], kTimes[l]});
    out.g_space[l].resize(g.space[l].size()), out.g_time[l].resize(g.times[l].size());
    out.p_space[l].resize(g.space[l].size()), out.p_time[l].resize(g.times[l].size());
    grads.push_back({out.g_space[l].data(), out.g_time[l].data()});
    penalty_grads.push_back({out.p_space[l].data(), out.p_time[l].data()});
  }
  out.features.resize(g.points * 2 * g.channels), out.order.resize(g.points), out.g_coords.resize(3 * g.points);
  const HexPlane<S> planes{levels, g.channels, g.time};
  const PlanePoints<S> points{coords.data(), g.points};
  hexplane_forward(planes, points, out.features.data(), out.order.data(), threads);
  hexplane_backward<S>(planes, points, out.order.data(), g_features.data(), grads, out.g_coords.data(), threads);
  out.penalty = plane_penalty<S>(planes, kPenalty, penalty_grads, threads);
  return out;
}

// Bilinear interpolation in a plane (rows, size, C) at fast coordinate x and row coordinate y, in samples.
double bilinear(const double* plane, int64_t rows, int64_t size, int64_t channels, int64_t c, double x, double y) {
  const int64_t i = std::clamp<int64_t>(static_cast<int64_t>(x), 0, size - 2);
  const int64_t j = std::clamp<int64_t>(static_cast<int64_t>(y), 0, rows - 2);
  const auto at = [&](int64_t row, int64_t col) { return plane[(row * size + col) * channels + c]; };
  const double fx = x - i, fy = y - j;
  return (1 - fy) * ((1 - fx) * at(j, i) + fx * at(j, i + 1)) + fy * ((1 - fx) * at(j + 1, i) + fx * at(j + 1, i + 1));
}

Values plain_features(const Grids& g) {
  Values out;
  constexpr int kFast[] = {0, 0, 1}, kSlow[] = {1, 2, 2};  // xy, xz, yz
  for (int64_t m = 0; m < g.points; ++m)
    for (int l = 0; l < 2; ++l)
      for (int64_t c = 0; c < g.channels; ++c) {
        double product = 1, x[3];
        for (int a = 0; a < 3; ++a) x[a] = (g.coords[3 * m + a] + 1) / 2 * (kSizes[l] - 1);
        for (int a = 0; a < 3; ++a) {
          const double* space = g.space[l].data() + a * kSizes[l] * kSizes[l] * g.channels;
          const double* time = g.times[l].data() + a * kTimes[l] * kSizes[l] * g.channels;
          product *= bilinear(space, kSizes[l], kSizes[l], g.channels, c, x[kFast[a]], x[kSlow[a]]);
          product *= bilinear(time, kTimes[l], kSizes[l], g.channels, c, x[a], g.time * (kTimes[l] - 1));
        }
        out.push_back(product);
      }
  return out;
}

// Mean squared second difference down the rows or along the columns of three planes (rows, size, C), summed over planes.
double roughness(const Values& planes, int64_t rows, int64_t size, int64_t channels, bool down) {
  double sum = 0;
  int64_t count = 0;
  const int64_t step = down ? size * channels : channels;
  for (int64_t p = 0; p < 3; ++p)
    for (int64_t j = 0; j < (down ? rows - 2 : rows); ++j)
      for (int64_t k = 0; k < (down ? size : size - 2) * channels; ++k, ++count) {
        const double* at = planes.data() + (p * rows + j) * size * channels + k;
        sum += std::pow(at[0] - 2 * at[step] + at[2 * step], 2);
      }
  return 3 * sum / static_cast<double>(count);
}

double plain_penalty(const Grids& g) {
  double sum = 0;
  for (int l = 0; l < 2; ++l) {
    for (bool down : {false, true})
      sum += kPenalty.space * 0.5 * roughness(g.space[l], kSizes[l], kSizes[l], g.channels, down);
    sum += kPenalty.time * roughness(g.times[l], kTimes[l], kSizes[l], g.channels, true);
    double away = 0;
    for (double x : g.times[l]) away += std::abs(1 - x);
    sum += kPenalty.one * 3 * away / static_cast<double>(g.times[l].size());
  }
  return sum;
}

void test_planes(int64_t channels, int64_t points) {
  Grids g{channels, points, 0.4, {}, {}, uniforms(3 * points, -0.99, 0.99)};
  for (int l = 0; l < 2; ++l) {
    g.space[l] = uniforms(3 * kSizes[l] * kSizes[l] * channels, 0.5, 1.5);
    g.times[l] = uniforms(3 * kTimes[l] * kSizes[l] * channels, 0.5, 1.5);
  }
  const Values cotangent = uniforms(points * 2 * channels, -1, 1);
  const auto d = features_of<double>(g, cotangent, 1);
  const std::string what = "planes, C=" + std::to_string(channels);
  expect_close(what, d.features, plain_features(g), 1e-12);
  expect_close(what + ", penalty", Values{d.penalty}, Values{plain_penalty(g)}, 1e-12);
  const auto by = [&](auto&& place, bool penalty) {
    return [&, place, penalty](const Values& x) {
      Grids moved = g;
      place(moved) = x;
      return penalty ? plain_penalty(moved) : dot(plain_features(moved), cotangent);
    };
  };
  const auto coords = [](Grids& m) -> Values& { return m.coords; };
  const auto space = [](Grids& m) -> Values& { return m.space[1]; };
  const auto times = [](Grids& m) -> Values& { return m.times[0]; };
  expect_gradient(what + ", by points", by(coords, false), g.coords, d.g_coords, 1e-6, 1e-7);
  expect_gradient(what + ", by space", by(space, false), g.space[1], d.g_space[1], 1e-5, 1e-7);
  expect_gradient(what + ", by time", by(times, false), g.times[0], d.g_time[0], 1e-5, 1e-7);
  expect_gradient(what + ", penalty by space", by(space, true), g.space[1], d.p_space[1], 1e-5, 1e-7);
  expect_gradient(what + ", penalty by time", by(times, true), g.times[0], d.p_time[0], 1e-5, 1e-7);
  const auto f = features_of<float>(g, cotangent, 1), four = features_of<float>(g, cotangent, 4);
  expect_close("float " + what, f.features, d.features, 1e-5);
  expect_close("float " + what + ", by points", f.g_coords, d.g_coords, 1e-4);
  expect_close("float " + what + ", by space", f.g_space[1], d.g_space[1], 1e-4);
  expect_same_bits(what + " on 4 threads", f.features, four.features);
  expect_same_bits(what + " on 4 threads, by points", f.g_coords, four.g_coords);
  for (int l = 0; l < 2; ++l) {
    expect_same_bits(what + " on 4 threads, by space", f.g_space[l], four.g_space[l]);
    expect_same_bits(what + " on 4 threads, by time", f.g_time[l], four.g_time[l]);
    expect_same_bits(what + " on 4 threads, penalty", f.p_space[l], four.p_space[l]);
  }
}

// Perceptron --------------------------------------------------------------------------------------------------------

Values plain_network(const std::vector<int64_t>& widths, int64_t skip, const Values& params, const Values& x,
                     int64_t rows) {
  Values out;
  const int64_t layers = static_cast<int64_t>(widths.size()) - 1;
  for (int64_t r = 0; r < rows; ++r) {
    const Values input(x.begin() + r * widths[0], x.begin() + (r + 1) * widths[0]);
    Values h = input;
    const double* p = params.data();
    for (int64_t l = 0; l < layers; ++l) {
      if (l > 0 && l == skip) h.insert(h.end(), input.begin(), input.end());
      Values next(widths[l + 1]);
      for (double& sum : next)
        for (double e : h) sum += *p++ * e;
      for (double& sum : next) sum += *p++;
      if (l + 1 < layers)
        for (double& sum : next) sum = std::max(sum, 0.0);
      h = next;
    }
    out.insert(out.end(), h.begin(), h.end());
  }
  return out;
}

template <class S>
struct Network {
  std::vector<S> y, g_x, g_params;
};

template <class S>
Network<S> run_network(const std::vector<int64_t>& widths, int64_t skip, const Values& params, const Values& x,
                       const Values& g_y, int threads, bool keep) {
  const auto p = as<S>(params), inputs = as<S>(x), by_y = as<S>(g_y);
  const Perceptron<S> net{widths, skip, p.data(), threads};
  const int64_t rows = static_cast<int64_t>(x.size()) / widths[0];
  // the kernels' vectors need this alignment
  const auto kept = std::make_unique<S[]>(rows * net.kept_per_row() + 64);
  S* aligned = kept.get() + (64 - reinterpret_cast<uintptr_t>(kept.get()) % 64) % 64 / sizeof(S);
  Network<S> out{std::vector<S>(rows * widths.back()), std::vector<S>(x.size()), std::vector<S>(params.size())};
  perceptron_forward(net, rows, inputs.data(), out.y.data(), keep ? aligned : nullptr);
  perceptron_backward(net, rows, inputs.data(), by_y.data(), keep ? aligned : nullptr, out.g_x.data(),
                      out.g_params.data());
  return out;
}

void test_perceptron(const std::vector<int64_t>& widths, int64_t skip) {
  const int64_t rows = 301;
  const int64_t num_params = Perceptron<double>{widths, skip, nullptr, 1}.num_params();
  const Values params = uniforms(num_params, -0.5, 0.5), x = uniforms(rows * widths[0], -1, 1);
  const Values g_y = uniforms(rows * widths.back(), -1, 1);
  const auto d = run_network<double>(widths, skip, params, x, g_y, 1, true);
  expect_close("network", d.y, plain_network(widths, skip, params, x, rows), 1e-12);
  const auto by_params = [&](const Values& p) { return dot(plain_network(widths, skip, p, x, rows), g_y); };
  const auto by_x = [&](const Values& at) { return dot(plain_network(widths, skip, params, at, rows), g_y); };
  expect_gradient("network by parameters", by_params, params, d.g_params, 1e-7, 1e-6);
  expect_gradient("network by inputs", by_x, x, d.g_x, 1e-7, 1e-6);
  const auto f = run_network<float>(widths, skip, params, x, g_y, 1, true);
  const auto four = run_network<float>(widths, skip, params, x, g_y, 4, true);
  const auto again = run_network<float>(widths, skip, params, x, g_y, 4, false);
  expect_close("float network", f.y, d.y, 1e-5),
      expect_close("float network by parameters", f.g_params, d.g_params, 1e-3);
  for (const auto& other : {four, again}) {
    expect_same_bits("network on 4 threads", f.y, other.y);
    expect_same_bits("network on 4 threads, by inputs", f.g_x, other.g_x);
    expect_same_bits("network on 4 threads, by parameters", f.g_params, other.g_params);
  }
}

// The rest ----------------------------------------------------------------------------------------------------------

template <class S>
std::vector<S> moved_rows(int threads) {
  generator().seed(11);
  const int64_t n = 6000, count = n / 2;
  Indices rows(count);
  for (int64_t i = 0; i < count; ++i) rows[i] = n - 1 - 2 * i;
  auto means = as<S>(uniforms(3 * n, -1, 1)), quats = as<S>(uniforms(4 * n, -1, 1)), scales = means,
       sh = as<S>(uniforms(12 * n, -1, 1));
  auto opacities = as<S>(uniforms(n, -1, 1));
  const auto by_means = as<S>(uniforms(3 * count, -1, 1)), by_quats = as<S>(uniforms(4 * count, -1, 1));
  const RowOffsets<S> offsets{count,           rows.data(),     by_means.data(), by_quats.data(),
                              by_means.data(), by_quats.data(), by_means.data()};
  const S unmoved = means[0];
  add_offsets(offsets, MovedGaussians<S>{means.data(), quats.data(), scales.data(), opacities.data(), sh.data(), 12},
              threads);
  expect(means[0] == unmoved, "rows not asked for stay");
  for (const auto& more : {quats, scales, opacities, sh}) means.insert(means.end(), more.begin(), more.end());
  return means;
}

template <class S>
std::vector<S> shaded(int threads) {
  generator().seed(12);
  const int64_t n = 3000;
  const Indices picked = random_indices(n, n);
  const auto means = as<S>(uniforms(3 * n, -3, 3)), quats = as<S>(uniforms(4 * n, -1, 1)),
             scales = as<S>(uniforms(3 * n, -1, 1));
  const auto base = as<S>(uniforms(3 * n, 0, 1)), places = as<S>(uniforms(3 * n, -3, 3));
  const S eye[] = {S(0.25), S(-4), S(0.5)}, box[] = {S(0), S(0), S(0), S(1), S(2), S(1)};
  const S turn[] = {S(0), S(1), S(0), S(-1), S(0), S(0), S(0), S(0), S(1)};
  const Shading<S> in{n,   picked.data(), means.data(), quats.data(), scales.data(), base.data(), eye,
                      box, places.data(), turn,         true,         true,          S(0.5),      threads};
  std::vector<S> out(n * in.width());
  shading_inputs(in, out.data());
  return out;
}

}  // namespace

int main() {
  skip_unless_supported();
  for (int64_t width : {1, 5, 8}) test_skinning(width);
  for (int64_t channels : {1, 8, 19}) test_planes(channels, 150);
  test_planes(16, 3000);  // more points than one thread takes at a time
  test_perceptron({5, 24, 24, 3}, 2), test_perceptron({33, 70, 70, 70, 9}, 0), test_perceptron({4, 1}, 0);
  expect_close("float offsets", moved_rows<float>(1), moved_rows<double>(1), 1e-6);
  expect_same_bits("offsets on 4 threads", moved_rows<float>(1), moved_rows<float>(4));
  expect_close("float shading", shaded<float>(1), shaded<double>(1), 1e-5);
  expect_same_bits("shading on 4 threads", shaded<float>(1), shaded<float>(4));
  return report();
}
