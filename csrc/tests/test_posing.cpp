// Skinning by joints, as a program without Python: against plain formulas in double, its gradients against central
// differences, float against double, many threads against one.
#include <cmath>
#include <numeric>

#include "core/api.hpp"
#include "tests/check.hpp"

namespace {

using namespace dyngs;
using namespace check;

struct Body {
  int64_t count, joints;
  Values means, quats, log_scales, weights, transforms;
};

Body random_body(int64_t count, int64_t joints) {
  Body b{count, joints, uniforms(3 * count, -1, 1), uniforms(4 * count, 0.3, 1), uniforms(3 * count, -4, -2), {}, {}};
  b.weights = uniforms(count * joints, 0, 1), b.transforms = uniforms(12 * joints, -1, 1);
  for (int64_t i = 0; i < count; ++i) {  // three joints each
    double* row = b.weights.data() + i * joints;
    for (int64_t j = 0; j < joints; ++j) row[j] *= (j + i) % joints < 3;
    const double total = std::accumulate(row, row + joints, 0.0);
    for (int64_t j = 0; j < joints; ++j) row[j] = static_cast<float>(row[j] / total);
  }
  return b;
}

template <class S>
struct PosedBody {
  std::vector<S> means, quats, log_scales, blended, g_means, g_quats, g_log_scales, g_weights, g_transforms;
};

// `g`: gradients by means, quaternions, log scales and blended transforms, each of as many rows as there are Gaussians.
template <class S>
PosedBody<S> pose(const Body& b, const Values (&g)[4], int threads, bool all = true) {
  const auto means = as<S>(b.means), quats = as<S>(b.quats), log_scales = as<S>(b.log_scales);
  const auto weights = as<S>(b.weights), transforms = as<S>(b.transforms);
  const std::vector<S> by[4] = {as<S>(g[0]), as<S>(g[1]), as<S>(g[2]), as<S>(g[3])};
  PosedBody<S> r{means, quats, log_scales, by[3], means, quats, log_scales, {}, transforms};
  std::vector<S> kept(12 * b.count);
  if (all) r.g_weights.resize(weights.size());
  const Posing<S> in{b.count,           b.joints,       means.data(),     quats.data(),
                     log_scales.data(), weights.data(), transforms.data()};
  pose_forward(in, Posed<S>{r.means.data(), r.quats.data(), r.log_scales.data(), r.blended.data(), kept.data()},
               threads);
  const Posed<const S> posed{nullptr, r.quats.data(), nullptr, r.blended.data(), kept.data()};
  pose_backward(in, posed, {by[0].data(), by[1].data(), by[2].data(), all ? by[3].data() : nullptr},
                {r.g_means.data(), r.g_quats.data(), r.g_log_scales.data(), all ? r.g_weights.data() : nullptr,
                 r.g_transforms.data()},
                threads);
  return r;
}

// R diag(s) of Gaussian i, times its transpose.
void plain_covariance(const Values& quats, const Values& log_scales, int64_t i, double (&to)[3][3]) {
  const double *q = quats.data() + 4 * i, square = q[0] * q[0] + q[1] * q[1] + q[2] * q[2] + q[3] * q[3];
  double half[3][3];
  for (int k = 0; k < 3; ++k) {  // the column k: e_k + 2 w u x e_k + 2 u x (u x e_k)
    const double* u = q + 1;
    const int l = (k + 1) % 3, m = (k + 2) % 3;
    const double s = std::exp(log_scales[3 * i + k]);
    half[k][k] = s * (1 - 2 * (u[l] * u[l] + u[m] * u[m]) / square);
    half[l][k] = s * 2 * (u[k] * u[l] + q[0] * u[m]) / square;
    half[m][k] = s * 2 * (u[k] * u[m] - q[0] * u[l]) / square;
  }
  for (int r = 0; r < 3; ++r)
    for (int c = 0; c < 3; ++c) {
      to[r][c] = 0;
      for (int k = 0; k < 3; ++k) to[r][c] += half[r][k] * half[c][k];
    }
}

// Means, covariances and blended transforms, 24 numbers per Gaussian, from plain formulas.
Values plain_posed(const Body& b) {
  Values out;
  for (int64_t i = 0; i < b.count; ++i) {
    double t[3][4] = {}, still[3][3];
    for (int64_t j = 0; j < b.joints; ++j)
      for (int k = 0; k < 12; ++k) t[k / 4][k % 4] += b.weights[i * b.joints + j] * b.transforms[12 * j + k];
    plain_covariance(b.quats, b.log_scales, i, still);
    for (const auto& row : t) {
      double x = row[3];
      for (int c = 0; c < 3; ++c) x += row[c] * b.means[3 * i + c];
      out.push_back(x);
    }
    for (const auto& left : t)
      for (const auto& right : t) {
        double sum = 0;
        for (int k = 0; k < 9; ++k) sum += left[k / 3] * still[k / 3][k % 3] * right[k % 3];
        out.push_back(1e3 * sum);
      }
    out.insert(out.end(), t[0], t[0] + 12);
  }
  return out;
}

template <class S>
Values all_of(const PosedBody<S>& r) {
  Values out;
  const Values quats = as<double>(r.quats), log_scales = as<double>(r.log_scales);
  for (size_t i = 0; i < r.means.size() / 3; ++i) {
    double moved[3][3];
    plain_covariance(quats, log_scales, i, moved);
    for (int c = 0; c < 3; ++c) out.push_back(r.means[3 * i + c]);
    for (const auto& row : moved)
      for (double x : row) out.push_back(1e3 * x);
    for (int k = 0; k < 12; ++k) out.push_back(r.blended[12 * i + k]);
  }
  return out;
}

// `count` Gaussians; the last of sixteen, of a block, alone.
void test_posing(int64_t count, int64_t joints) {
  const Body b = random_body(count, joints);
  const Values g[4] = {uniforms(3 * count, -1, 1), uniforms(4 * count, -1, 1), uniforms(3 * count, -1, 1),
                       uniforms(12 * count, -1, 1)};
  const auto d = pose<double>(b, g, 1);
  const std::string what = ", " + std::to_string(count) + " Gaussians, " + std::to_string(joints) + " joints";
  expect_close("posing" + what, all_of(d), plain_posed(b), 1e-12);
  const auto by = [&](Values Body::* member) {
    return [&, member](const Values& x) {
      Body moved = b;
      moved.*member = x;
      const auto r = pose<double>(moved, g, 1);
      return dot(r.means, g[0]) + dot(r.quats, g[1]) + dot(r.log_scales, g[2]) + dot(r.blended, g[3]);
    };
  };
  expect_gradient("posing by means" + what, by(&Body::means), b.means, d.g_means, 1e-6, 1e-6);
  expect_gradient("posing by quaternions" + what, by(&Body::quats), b.quats, d.g_quats, 1e-6, 1e-6);
  expect_gradient("posing by scales" + what, by(&Body::log_scales), b.log_scales, d.g_log_scales, 1e-6, 1e-6);
  expect_gradient("posing by weights" + what, by(&Body::weights), b.weights, d.g_weights, 1e-6, 1e-6);
  expect_gradient("posing by transforms" + what, by(&Body::transforms), b.transforms, d.g_transforms, 1e-6, 1e-6);
  const auto f = pose<float>(b, g, 1), four = pose<float>(b, g, 4), less = pose<float>(b, g, 1, false);
  expect_close("float posing" + what, all_of(f), all_of(d), 1e-5);
  expect_same_bits("posing on 4 threads" + what, f.quats, four.quats);
  expect_same_bits("gradients by transforms on 4 threads" + what, f.g_transforms, four.g_transforms);
  expect_same_bits("gradients by weights on 4 threads" + what, f.g_weights, four.g_weights);
  expect_same_bits("gradients by scales without those by weights" + what, f.g_log_scales, less.g_log_scales);
}

}  // namespace

int main() {
  skip_unless_supported();
  test_posing(1, 1), test_posing(47, 5), test_posing(1300, 24);
  return report();
}
