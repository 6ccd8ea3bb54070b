// Projection and its backward pass (math/projection.hpp), one thread per Gaussian.
//
// Limits, H100 (3.35 TB/s, 67 TFLOP/s). Forward, per Gaussian and view: 44 bytes read, 32 written, about 250 operations: 23 ps
// of bandwidth, 4 ps of arithmetic: bound by memory, 1 M Gaussians in one view no faster than 23 us. Backward: 44 + 36 bytes
// read, 40 written and about 800 operations: 36 ps against 12. All arrays are rows of 3 or 4 floats read by neighbouring
// threads, so whole sectors are used.
#include "cuda/api.hpp"
#include "cuda/reduce.hpp"
#include "math/projection.hpp"

namespace dyngs::cuda {
namespace {

constexpr int kThreads = 128;
constexpr int kCamera = 16;  // numbers per camera: its rotation and translation (3, 4), fx, fy, cx, cy

__device__ Pinhole<float> load_pinhole(const GaussianViews<float>& in, const ProjectOptions<float>& options,
                                       int64_t view) {
  const Array<const float> from = global(in.viewmats) + 16 * view, lens = global(in.intrinsics) + 9 * view;
  float viewmat[12], intrinsics[9];
  for (int i = 0; i < 12; ++i) viewmat[i] = from[i];
  for (int i = 0; i < 9; ++i) intrinsics[i] = lens[i];
  return pinhole(viewmat, intrinsics, options.width, options.height);
}

struct Loaded {
  Vec3<float> mean, scale;
  Quat<float> unit;
  float inv_norm;
};

__device__ Loaded load_gaussian(const GaussianViews<float>& in, int64_t i) {
  const Array<const float> m = global(in.means) + 3 * i, q = global(in.quats) + 4 * i, s = global(in.scales) + 3 * i;
  Loaded g;
  g.mean = {m[0], m[1], m[2]}, g.scale = {s[0], s[1], s[2]};
  g.unit = normalize(Quat<float>{q[0], q[1], q[2], q[3]}, g.inv_norm);
  return g;
}

__global__ void __launch_bounds__(kThreads)
    project_kernel(GaussianViews<float> in, ProjectOptions<float> options, Projected<float> out) {
  const int64_t row = int64_t{blockIdx.x} * kThreads + threadIdx.x;
  if (row >= in.num_gaussians * in.num_views) return;
  const int64_t view = row / in.num_gaussians, i = row % in.num_gaussians;
  const Pinhole<float> cam = load_pinhole(in, options, view);
  const Loaded g = load_gaussian(in, i);
  Vec3<float> p = to_camera(cam, g.mean);
  const bool in_range = (p.z > options.near) & (p.z < options.far);
  p.z = select(in_range, p.z, 1.f);
  ProjectionState<float> state;
  const Splat<float> splat = project(cam, p, g.unit, g.scale, options.eps2d, state);
  const Conic<float>& conic = splat.conic;
  const float given = global(in.opacities)[i], opacity = options.antialiased ? given * conic.compensation : given;
  const Extent<float> e =
      visible_extent(splat, opacity, Vec2<float>{cam.width, cam.height}, options.alpha_min, options.radius_clip);
  const bool visible = in_range & e.visible;
  const Array<float> means2d = global(out.means2d) + 2 * row, factors = global(out.factors) + 3 * row;
  const Array<int32_t> radii = global(out.radii) + 2 * row;
  means2d[0] = select(visible, splat.x, 0.f), means2d[1] = select(visible, splat.y, 0.f);
  global(out.depths)[row] = select(visible, splat.depth, 0.f);
  factors[0] = select(visible, conic.u, 0.f), factors[1] = select(visible, conic.w, 0.f);
  factors[2] = select(visible, conic.v, 0.f);
  global(out.compensations)[row] = select(visible, conic.compensation, 0.f);
  radii[0] = visible ? static_cast<int32_t>(e.x) : 0, radii[1] = visible ? static_cast<int32_t>(e.y) : 0;
}

struct Sums {
  Vec3<float> mean{}, scale{};
  Quat<float> unit{};
};

// Adds one view's gradients to `sum`; `camera` (kCamera numbers) receives those of the camera.
__device__ void add_view(const Pinhole<float>& cam, const Loaded& g, float eps2d, const SplatGrad<float>& by_splat,
                         Sums& sum, float* camera) {
  ProjectionState<float> state;
  const Splat<float> splat = project(cam, to_camera(cam, g.mean), g.unit, g.scale, eps2d, state);
  const ProjectionGrad<float> d = project_vjp(cam, g.unit, g.scale, eps2d, state, splat, by_splat);
  sum.mean = sum.mean + transposed_times(cam.rotation, d.cam);
  sum.scale = sum.scale + d.scale;
  sum.unit.w += d.unit.w, sum.unit.x += d.unit.x, sum.unit.y += d.unit.y, sum.unit.z += d.unit.z;
  if (camera == nullptr) return;
  for (int i = 0; i < 3; ++i) {
    for (int j = 0; j < 3; ++j) camera[4 * i + j] = d.cam[i] * g.mean[j] + d.view[i][j];
    camera[4 * i + 3] = d.cam[i];
  }
  const IntrinsicsGrad<float> lens = intrinsics_vjp(state, by_splat, d);
  camera[12] = lens.fx, camera[13] = lens.fy, camera[14] = lens.cx, camera[15] = lens.cy;
}

__device__ SplatGrad<float> load_grads(const ProjectedGrads<float>& grads, int64_t row) {
  const Array<const float> m = global(grads.means2d) + 2 * row, f = global(grads.factors) + 3 * row;
  return {m[0], m[1], global(grads.depths)[row], {f[0], f[1], f[2], global(grads.compensations)[row]}};
}

// `partials` (blocks, V, kCamera): sums over each block's Gaussians, in double, as a camera sees millions.
template <bool kCameras>
__global__ void __launch_bounds__(kThreads)
    project_backward_kernel(GaussianViews<float> in, ProjectOptions<float> options, const int32_t* radii,
                            ProjectedGrads<float> grads, GaussianGrads<float> out, double* partials) {
  DYNGS_SHARED(double, warp_sums, kThreads / kWarpSize);
  const int64_t i = int64_t{blockIdx.x} * kThreads + threadIdx.x;
  const bool exists = i < in.num_gaussians;
  const Array<const int32_t> extents = global(radii);
  Loaded g{};
  if (exists) g = load_gaussian(in, i);
  Sums sum;
  for (int64_t view = 0; view < in.num_views; ++view) {
    const int64_t row = view * in.num_gaussians + i;
    float camera[kCamera] = {};
    if (exists && extents[2 * row] > 0)
      add_view(load_pinhole(in, options, view), g, options.eps2d, load_grads(grads, row), sum,
               kCameras ? camera : nullptr);
    if constexpr (kCameras) {
      const Array<double> to = global(partials) + (int64_t{blockIdx.x} * in.num_views + view) * kCamera;
      for (int k = 0; k < kCamera; ++k) {
        const double total = block_sum(static_cast<double>(camera[k]), warp_sums);
        if (threadIdx.x == 0) to[k] = total;
      }
    }
  }
  if (!exists) return;
  const Quat<float> q = normalize_vjp(g.unit, g.inv_norm, sum.unit);
  const Array<float> means = global(out.means) + 3 * i, scales = global(out.scales) + 3 * i;
  const Array<float> quats = global(out.quats) + 4 * i;
  for (int k = 0; k < 3; ++k) means[k] = sum.mean[k], scales[k] = sum.scale[k];
  quats[0] = q.w, quats[1] = q.x, quats[2] = q.y, quats[3] = q.z;
}

// One block per view: thread k adds up number k of the camera.
__global__ void sum_cameras_kernel(const double* partials, int64_t blocks, int64_t views, float* viewmats,
                                   float* intrinsics) {
  const int64_t view = blockIdx.x;
  const int k = static_cast<int>(threadIdx.x);
  if (k >= 25) return;
  // where in (4, 4) and then in (3, 3) the 16 numbers belong
  const int lens = k - 16, of_camera = k < 12      ? k
                                       : lens == 0 ? 12
                                       : lens == 4 ? 13
                                       : lens == 2 ? 14
                                       : lens == 5 ? 15
                                                   : -1;
  double total = 0;
  if (of_camera >= 0)
    for (int64_t b = 0; b < blocks; ++b) total += global(partials)[(b * views + view) * kCamera + of_camera];
  if (k < 16) {
    global(viewmats)[view * 16 + k] = static_cast<float>(total);
  } else {
    global(intrinsics)[view * 9 + lens] = static_cast<float>(total);
  }
}

}  // namespace

void project_forward(const GaussianViews<float>& in, const ProjectOptions<float>& options, const Projected<float>& out,
                     Stream stream) {
  launch("project", {blocks_for(in.num_gaussians * in.num_views, kThreads), kThreads}, stream, project_kernel, in,
         options, out);
}

int64_t project_backward_workspace(int64_t num_gaussians, int64_t num_views) {
  return blocks_for(num_gaussians, kThreads) * num_views * kCamera * int64_t{sizeof(double)};
}

void project_backward(const GaussianViews<float>& in, const ProjectOptions<float>& options, const int32_t* radii,
                      const ProjectedGrads<float>& grads, const GaussianGrads<float>& out, const Lent& workspace,
                      Stream stream) {
  const int64_t blocks = blocks_for(in.num_gaussians, kThreads);
  if (out.viewmats == nullptr) {
    launch("project_backward", {blocks, kThreads}, stream, project_backward_kernel<false>, in, options, radii, grads,
           out, static_cast<double*>(nullptr));
    return;
  }
  auto* partials = Workspace(workspace.memory, workspace.bytes).take<double>(blocks * in.num_views * kCamera);
  launch("project_backward", {blocks, kThreads}, stream, project_backward_kernel<true>, in, options, radii, grads, out,
         partials);
  launch("sum_cameras", {in.num_views, kWarpSize}, stream, sum_cameras_kernel, static_cast<const double*>(partials),
         blocks, in.num_views, out.viewmats, out.intrinsics);
}

}  // namespace dyngs::cuda
