// Projection of N Gaussians into V views, 16 Gaussians at a time, and its backward pass.
#include <cmath>

#include "core/api.hpp"
#include "cpu/parallel.hpp"
#include "cpu/simd.hpp"
#include "math/projection.hpp"

namespace dyngs {
namespace {

constexpr int64_t kBlock = 64 * kLanes;  // Gaussians per work item

template <class S>
Pinhole<S> load_pinhole(const GaussianViews<S>& in, const ProjectOptions<S>& options, int64_t view) {
  return pinhole(in.viewmats + view * 16, in.intrinsics + view * 9, options.width, options.height);
}

// Column `c` of rows first..first+15 of an (N, stride) array; lanes past `count` repeat the last row.
template <class S>
Packet<S> load_column(const S* rows, int64_t first, int count, int stride, int c) {
  Packet<S> r;
  for (int i = 0; i < kLanes; ++i) r[i] = rows[(first + std::min(i, count - 1)) * stride + c];
  return r;
}

template <class S>
void store_column(Packet<S> x, S* rows, int64_t first, int count, int stride, int c) {
  for (int i = 0; i < count; ++i) rows[(first + i) * stride + c] = x[i];
}

template <class S>
struct Loaded {
  Vec3<Packet<S>> mean, scale;
  Quat<Packet<S>> unit;
  Packet<S> inv_norm, opacity;
};

template <class S>
Loaded<S> load_gaussians(const GaussianViews<S>& in, int64_t first, int count) {
  const auto column = [&](const S* rows, int stride, int c) { return load_column(rows, first, count, stride, c); };
  Loaded<S> g;
  g.mean = {column(in.means, 3, 0), column(in.means, 3, 1), column(in.means, 3, 2)};
  g.scale = {column(in.scales, 3, 0), column(in.scales, 3, 1), column(in.scales, 3, 2)};
  g.unit = normalize(
      Quat<Packet<S>>{column(in.quats, 4, 0), column(in.quats, 4, 1), column(in.quats, 4, 2), column(in.quats, 4, 3)},
      g.inv_norm);
  g.opacity = column(in.opacities, 1, 0);
  return g;
}

template <class S>
void project_block(const GaussianViews<S>& in, const ProjectOptions<S>& options, const Pinhole<S>& cam, int64_t view,
                   int64_t first, int count, const Projected<S>& out) {
  using P = Packet<S>;
  const Loaded<S> g = load_gaussians(in, first, count);
  Vec3<P> p = to_camera(cam, g.mean);
  const PacketMask<S> in_range = (p.z > P(options.near)) & (p.z < P(options.far));
  p.z = select(in_range, p.z, P(S(1)));
  ProjectionState<P> state;
  const Splat<P> splat = project(cam, p, g.unit, g.scale, options.eps2d, state);
  const P opacity = options.antialiased ? g.opacity * splat.conic.compensation : g.opacity;
  const Extent<P> e =
      visible_extent(splat, opacity, Vec2<S>{cam.width, cam.height}, options.alpha_min, options.radius_clip);
  const PacketMask<S> visible = in_range & e.visible;
  const auto shown = [&](P x) { return select(visible, x, P(S(0))); };
  const int64_t row = view * in.num_gaussians + first;
  store_column(shown(splat.x), out.means2d, row, count, 2, 0);
  store_column(shown(splat.y), out.means2d, row, count, 2, 1);
  store_column(shown(splat.depth), out.depths, row, count, 1, 0);
  store_column(shown(splat.conic.u), out.factors, row, count, 3, 0);
  store_column(shown(splat.conic.w), out.factors, row, count, 3, 1);
  store_column(shown(splat.conic.v), out.factors, row, count, 3, 2);
  store_column(shown(splat.conic.compensation), out.compensations, row, count, 1, 0);
  const P rx = shown(e.x), ry = shown(e.y);
  for (int i = 0; i < count; ++i) {
    out.radii[2 * (row + i)] = static_cast<int32_t>(rx[i]);
    out.radii[2 * (row + i) + 1] = static_cast<int32_t>(ry[i]);
  }
}

template <class S>
struct BlockGrads {
  Vec3<Packet<S>> mean, scale;
  Quat<Packet<S>> unit;
};

// Numbers per camera: its rotation and translation (3, 4), fx, fy, cx, cy.
constexpr int kCamera = 16;

// Adds the gradients of one view for 16 Gaussians; `camera` (kCamera numbers) collects those of the camera.
template <class S>
void backward_view(const Pinhole<S>& cam, const Loaded<S>& g, const ProjectOptions<S>& options, const int32_t* radii,
                   const ProjectedGrads<S>& grads, int64_t row, int count, BlockGrads<S>& sum, double* camera) {
  using P = Packet<S>;
  P drawn(S(0));
  bool any_drawn = false;
  for (int i = 0; i < count; ++i)
    if (radii[2 * (row + i)] > 0) drawn[i] = S(1), any_drawn = true;
  if (!any_drawn) return;
  const PacketMask<S> visible = drawn > P(S(0));
  const auto load = [&](const S* rows, int stride, int c) {
    return select(visible, load_column(rows, row, count, stride, c), P(S(0)));
  };
  const Vec3<P> world = g.mean;
  Vec3<P> p = to_camera(cam, world);
  p.z = select(visible, p.z, P(S(1)));
  ProjectionState<P> state;
  const Splat<P> splat = project(cam, p, g.unit, g.scale, options.eps2d, state);
  const SplatGrad<P> gs{load(grads.means2d, 2, 0),
                        load(grads.means2d, 2, 1),
                        load(grads.depths, 1, 0),
                        {load(grads.factors, 3, 0), load(grads.factors, 3, 1), load(grads.factors, 3, 2),
                         load(grads.compensations, 1, 0)}};
  ProjectionGrad<P> d = project_vjp(cam, g.unit, g.scale, options.eps2d, state, splat, gs);
  const auto kept = [&](P x) { return select(visible, x, P(S(0))); };  // culled lanes may hold NaN
  d.cam = {kept(d.cam.x), kept(d.cam.y), kept(d.cam.z)};
  sum.mean = sum.mean + transposed_times(cam.rotation, d.cam);
  sum.scale.x += kept(d.scale.x), sum.scale.y += kept(d.scale.y), sum.scale.z += kept(d.scale.z);
  sum.unit.w += kept(d.unit.w), sum.unit.x += kept(d.unit.x);
  sum.unit.y += kept(d.unit.y), sum.unit.z += kept(d.unit.z);
  if (camera == nullptr) return;
  const P gc[3] = {d.cam.x, d.cam.y, d.cam.z};
  const P w[3] = {world.x, world.y, world.z};
  for (int i = 0; i < 3; ++i) {
    for (int j = 0; j < 3; ++j) camera[4 * i + j] += horizontal_sum(kept(gc[i] * w[j] + d.view[i][j]));
    camera[4 * i + 3] += horizontal_sum(gc[i]);
  }
  const IntrinsicsGrad<P> lens = intrinsics_vjp(state, gs, d);
  camera[12] += horizontal_sum(kept(lens.fx)), camera[13] += horizontal_sum(kept(lens.fy));
  camera[14] += horizontal_sum(kept(lens.cx)), camera[15] += horizontal_sum(kept(lens.cy));
}

}  // namespace

template <class S>
void project_forward(const GaussianViews<S>& in, const ProjectOptions<S>& options, const Projected<S>& out) {
  for (int64_t view = 0; view < in.num_views; ++view) {
    const Pinhole<S> cam = load_pinhole(in, options, view);
    parallel_for(in.num_gaussians, kBlock, options.threads, [&](int64_t begin, int64_t end) {
      for (int64_t i = begin; i < end; i += kLanes)
        project_block(in, options, cam, view, i, static_cast<int>(std::min<int64_t>(kLanes, end - i)), out);
    });
  }
}

template <class S>
void project_backward(const GaussianViews<S>& in, const ProjectOptions<S>& options, const int32_t* radii,
                      const ProjectedGrads<S>& grads, const GaussianGrads<S>& out) {
  using P = Packet<S>;
  const int64_t blocks = (in.num_gaussians + kBlock - 1) / kBlock;
  std::vector<Pinhole<S>> cams;
  cams.reserve(in.num_views);
  for (int64_t v = 0; v < in.num_views; ++v) cams.push_back(load_pinhole(in, options, v));
  std::vector<double> camera(out.viewmats ? blocks * in.num_views * kCamera
                                          : 0);  // per block: summed in fixed order below
  parallel_for(in.num_gaussians, kBlock, options.threads, [&](int64_t begin, int64_t end) {
    for (int64_t i = begin; i < end; i += kLanes) {
      const int count = static_cast<int>(std::min<int64_t>(kLanes, end - i));
      const Loaded<S> g = load_gaussians(in, i, count);
      const P zero(S(0));
      BlockGrads<S> sum{{zero, zero, zero}, {zero, zero, zero}, {zero, zero, zero, zero}};
      for (int64_t v = 0; v < in.num_views; ++v) {
        double* cam_sum = out.viewmats ? camera.data() + ((begin / kBlock) * in.num_views + v) * kCamera : nullptr;
        backward_view(cams[v], g, options, radii, grads, v * in.num_gaussians + i, count, sum, cam_sum);
      }
      const Quat<P> q = normalize_vjp(g.unit, g.inv_norm, sum.unit);
      const auto store = [&](P x, S* rows, int stride, int c) { store_column(x, rows, i, count, stride, c); };
      store(sum.mean.x, out.means, 3, 0), store(sum.mean.y, out.means, 3, 1), store(sum.mean.z, out.means, 3, 2);
      store(sum.scale.x, out.scales, 3, 0), store(sum.scale.y, out.scales, 3, 1), store(sum.scale.z, out.scales, 3, 2);
      store(q.w, out.quats, 4, 0), store(q.x, out.quats, 4, 1);
      store(q.y, out.quats, 4, 2), store(q.z, out.quats, 4, 3);
    }
  });
  if (out.viewmats == nullptr) return;
  for (int64_t v = 0; v < in.num_views; ++v) {
    double total[kCamera] = {};
    for (int64_t b = 0; b < blocks; ++b)
      for (int k = 0; k < kCamera; ++k) total[k] += camera[(b * in.num_views + v) * kCamera + k];
    S* viewmat = out.viewmats + v * 16;
    for (int k = 0; k < 16; ++k) viewmat[k] = k < 12 ? static_cast<S>(total[k]) : S(0);
    S* intrinsics = out.intrinsics + v * 9;
    for (int k = 0; k < 9; ++k) intrinsics[k] = S(0);
    intrinsics[0] = static_cast<S>(total[12]), intrinsics[4] = static_cast<S>(total[13]);
    intrinsics[2] = static_cast<S>(total[14]), intrinsics[5] = static_cast<S>(total[15]);
  }
}

#define DYNGS_INSTANTIATE(S)                                                                                \
  template void project_forward<S>(const GaussianViews<S>&, const ProjectOptions<S>&, const Projected<S>&); \
  template void project_backward<S>(const GaussianViews<S>&, const ProjectOptions<S>&, const int32_t*,      \
                                    const ProjectedGrads<S>&, const GaussianGrads<S>&);
DYNGS_INSTANTIATE(float)
DYNGS_INSTANTIATE(double)
#undef DYNGS_INSTANTIATE

}  // namespace dyngs
