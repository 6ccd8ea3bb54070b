// View-dependent colour max(0, sum_k sh_k Y_k(d) + 0.5), d = (mean - centre) / |mean - centre|, and its backward pass.
#include "math/harmonics.hpp"

#include "core/api.hpp"
#include "cpu/parallel.hpp"
#include "cpu/simd.hpp"

namespace dyngs {
namespace {

constexpr int64_t kBlock = 32 * kLanes;

template <class S>
struct Direction {
  Vec3<Packet<S>> unit;
  Packet<S> inv_norm;
};

template <class S>
Direction<S> view_direction(const Harmonics<S>& in, int64_t view, int64_t first, int count) {
  Vec3<Packet<S>> ray;
  const S* c = in.centers + 3 * view;
  for (int i = 0; i < kLanes; ++i) {
    const S* m = in.means + 3 * (first + std::min(i, count - 1));
    ray.x[i] = m[0] - c[0], ray.y[i] = m[1] - c[1], ray.z[i] = m[2] - c[2];
  }
  Direction<S> d;
  d.unit = normalize(ray, d.inv_norm);
  return d;
}

template <class S>
void forward_lanes(const Harmonics<S>& in, int64_t view, int64_t first, int count, S* colors) {
  const int terms = (in.degree + 1) * (in.degree + 1);
  const Direction<S> d = view_direction(in, view, first, count);
  Packet<S> basis[kMaxShTerms];
  sh_basis(in.degree, d.unit.x, d.unit.y, d.unit.z, basis);
  for (int i = 0; i < count; ++i) {
    const int64_t row = view * in.num_gaussians + first + i;
    S rgb[3] = {S(0), S(0), S(0)};
    if (in.radii[2 * row] > 0) {
      const S* sh = in.sh + (first + i) * in.num_terms * 3;
      for (int c = 0; c < 3; ++c) rgb[c] = S(0.5);
      for (int k = 0; k < terms; ++k)
        for (int c = 0; c < 3; ++c) rgb[c] += basis[k][i] * sh[3 * k + c];
    }
    for (int c = 0; c < 3; ++c) colors[3 * row + c] = std::max(rgb[c], S(0));
  }
}

// Adds one view's gradients for 16 Gaussians. `center` (3) collects the gradient of the camera centre.
template <class S>
void backward_lanes(const Harmonics<S>& in, int64_t view, int64_t first, int count, const S* colors, const S* grads,
                    S* grad_means, S* grad_sh, double* center) {
  const int terms = (in.degree + 1) * (in.degree + 1);
  const int64_t base = view * in.num_gaussians + first;
  S g[kLanes][3];
  bool active[kLanes], any_active = false;
  for (int i = 0; i < count; ++i) {
    active[i] = false;
    for (int c = 0; c < 3; ++c) {
      g[i][c] = colors[3 * (base + i) + c] > S(0) ? grads[3 * (base + i) + c] : S(0);  // the clamp stops the gradient
      active[i] |= g[i][c] != S(0);
    }
    any_active |= active[i];
  }
  if (!any_active) return;
  const Direction<S> d = view_direction(in, view, first, count);
  Packet<S> basis[kMaxShTerms], weight[kMaxShTerms];
  sh_basis(in.degree, d.unit.x, d.unit.y, d.unit.z, basis);
  for (int i = 0; i < kLanes; ++i) {
    if (i >= count || !active[i]) {
      for (int k = 0; k < terms; ++k) weight[k][i] = S(0);
      continue;
    }
    const S* sh = in.sh + (first + i) * in.num_terms * 3;
    S* out = grad_sh + (first + i) * in.num_terms * 3;
    for (int k = 0; k < terms; ++k) {
      const S b = basis[k][i];
      S dot = S(0);
      for (int c = 0; c < 3; ++c) {
        out[3 * k + c] += b * g[i][c];
        dot += sh[3 * k + c] * g[i][c];
      }
      weight[k][i] = dot;
    }
  }
  if (in.degree == 0) return;
  Vec3<Packet<S>> by_unit;
  sh_basis_vjp(in.degree, d.unit.x, d.unit.y, d.unit.z, weight, by_unit.x, by_unit.y, by_unit.z);
  const Vec3<Packet<S>> by_ray = normalize_vjp(d.unit, d.inv_norm, by_unit);
  for (int i = 0; i < count; ++i) {
    S* out = grad_means + 3 * (first + i);
    out[0] += by_ray.x[i], out[1] += by_ray.y[i], out[2] += by_ray.z[i];
    if (center != nullptr) center[0] -= by_ray.x[i], center[1] -= by_ray.y[i], center[2] -= by_ray.z[i];
  }
}

}  // namespace

template <class S>
void harmonics_forward(const Harmonics<S>& in, S* colors) {
  for (int64_t v = 0; v < in.num_views; ++v)
    parallel_for(in.num_gaussians, kBlock, in.threads, [&](int64_t begin, int64_t end) {
      for (int64_t i = begin; i < end; i += kLanes)
        forward_lanes(in, v, i, static_cast<int>(std::min<int64_t>(kLanes, end - i)), colors);
    });
}

template <class S>
void harmonics_backward(const Harmonics<S>& in, const S* colors, const S* grad_colors, S* grad_means, S* grad_sh,
                        S* grad_centers) {
  const int64_t blocks = (in.num_gaussians + kBlock - 1) / kBlock;
  std::vector<double> centers(grad_centers ? blocks * in.num_views * 3 : 0);
  parallel_for(in.num_gaussians, kBlock, in.threads, [&](int64_t begin, int64_t end) {
    std::fill(grad_means + 3 * begin, grad_means + 3 * end, S(0));
    std::fill(grad_sh + 3 * in.num_terms * begin, grad_sh + 3 * in.num_terms * end, S(0));
    for (int64_t v = 0; v < in.num_views; ++v)
      for (int64_t i = begin; i < end; i += kLanes)
        backward_lanes(in, v, i, static_cast<int>(std::min<int64_t>(kLanes, end - i)), colors, grad_colors, grad_means,
                       grad_sh, grad_centers ? centers.data() + ((begin / kBlock) * in.num_views + v) * 3 : nullptr);
  });
  if (grad_centers == nullptr) return;
  for (int64_t v = 0; v < in.num_views; ++v)
    for (int c = 0; c < 3; ++c) {
      double total = 0;
      for (int64_t b = 0; b < blocks; ++b) total += centers[(b * in.num_views + v) * 3 + c];
      grad_centers[3 * v + c] = static_cast<S>(total);
    }
}

#define DYNGS_INSTANTIATE(S)                                   \
  template void harmonics_forward<S>(const Harmonics<S>&, S*); \
  template void harmonics_backward<S>(const Harmonics<S>&, const S*, const S*, S*, S*, S*);
DYNGS_INSTANTIATE(float)
DYNGS_INSTANTIATE(double)
#undef DYNGS_INSTANTIATE

}  // namespace dyngs
