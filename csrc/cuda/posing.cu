// Skinning by joints (math/posing.hpp). Forward, one thread per Gaussian. Backward, one thread per Gaussian, which leaves the
// gradient by its blended transform in the workspace; then one per weight; then the sums by the joints' transforms, of a run of
// Gaussians per block, and of all blocks in order: no atomics, the same bytes every time.
//
// Limits, H100 (3.35 TB/s, 67 TFLOP/s), J = 24 joints, whose transforms stay in the cache. Forward, per Gaussian: 40 + 4 J
// bytes read, 136 written: 81 ps; 24 J + 500 operations: 16 ps: bound by memory. Backward: 288 bytes read and 88 written, by
// the weights 48 + 4 J, the sums 48 + 4 J: 664 bytes, 0.2 ns; 48 J + 500 operations, 25 ps.
#include "cuda/api.hpp"
#include "cuda/reduce.hpp"
#include "cuda/rows.hpp"
#include "math/posing.hpp"

namespace dyngs::cuda {
namespace {

constexpr int kThreads = 128;
constexpr int kSumThreads = 256;
constexpr int kAffine = 12, kKept = 12;
constexpr int64_t kShortestRun = 64, kMostRuns = 512;  // of Gaussians in one block's sums

__device__ RestShape<float> load_shape(const Posing<float>& in, int64_t i) {
  const Vec3<float> v = load3(in.log_scales, i);
  const float logs[3] = {v.x, v.y, v.z};
  return rest_shape(load4(in.quats, i), logs);
}

__global__ void __launch_bounds__(kThreads) pose_kernel(Posing<float> in, Posed<float> out) {
  const int64_t i = int64_t{blockIdx.x} * kThreads + threadIdx.x;
  if (i >= in.count) return;
  float t[kAffine] = {};
  for (int64_t j = 0; j < in.joints; ++j) {
    const float weight = global(in.weights)[i * in.joints + j];
    DYNGS_UNROLL
    for (int k = 0; k < kAffine; ++k) t[k] += weight * global(in.transforms)[kAffine * j + k];
  }
  DYNGS_UNROLL
  for (int k = 0; k < kAffine; ++k) global(out.blended)[kAffine * i + k] = t[k];
  const Mat3<float> linear{{{t[0], t[1], t[2]}, {t[4], t[5], t[6]}, {t[8], t[9], t[10]}}};
  store3(out.means, i, moved_point(linear, {t[3], t[7], t[11]}, load3(in.means, i)));
  const MovedShape<float> moved = move_shape(linear, load_shape(in, i));
  store4(out.quats, i, moved.quat);
  store3(out.log_scales, i, {moved.log_scales[0], moved.log_scales[1], moved.log_scales[2]});
  const Array<float> kept = global(out.kept) + kKept * i;
  DYNGS_UNROLL
  for (int k = 0; k < 9; ++k) kept[k] = moved.turned.m[k / 3][k % 3];
  DYNGS_UNROLL
  for (int k = 0; k < 3; ++k) kept[9 + k] = moved.length[k];
}

// Writes the gradients by means, quaternions, log scales and blended transforms.
__global__ void __launch_bounds__(kThreads)
    pose_backward_kernel(Posing<float> in, Posed<const float> posed, PosedGrads<float> g, PosingGrads<float> out,
                         float* by_blended) {
  const int64_t i = int64_t{blockIdx.x} * kThreads + threadIdx.x;
  if (i >= in.count) return;
  Mat3<float> linear;
  MovedShape<float> moved;
  moved.quat = load4(posed.quats, i);
  DYNGS_UNROLL
  for (int k = 0; k < 9; ++k) {
    linear.m[k / 3][k % 3] = global(posed.blended)[kAffine * i + 4 * (k / 3) + k % 3];
    moved.turned.m[k / 3][k % 3] = global(posed.kept)[kKept * i + k];
  }
  DYNGS_UNROLL
  for (int k = 0; k < 3; ++k) moved.length[k] = global(posed.kept)[kKept * i + 9 + k];
  const Vec3<float> by_log = load3(g.log_scales, i), by_mean = load3(g.means, i);
  const float by_logs[3] = {by_log.x, by_log.y, by_log.z};
  MovedShapeGrad<float> by = move_shape_vjp(linear, load_shape(in, i), moved, load4(g.quats, i), by_logs);
  store4(out.quats, i, by.quat);
  store3(out.log_scales, i, {by.log_scales[0], by.log_scales[1], by.log_scales[2]});
  store3(out.means, i, moved_point_vjp(linear, load3(in.means, i), by_mean, by.linear));
  DYNGS_UNROLL
  for (int k = 0; k < kAffine; ++k) {
    float sum = k % 4 < 3 ? by.linear.m[k / 4][k % 4 < 3 ? k % 4 : 0] : by_mean[k / 4];
    if (g.blended != nullptr) sum += global(g.blended)[kAffine * i + k];
    global(by_blended)[kAffine * i + k] = sum;
  }
}

// One thread per weight.
__global__ void __launch_bounds__(kThreads) by_weights_kernel(Posing<float> in, const float* by_blended, float* out) {
  const int64_t at = int64_t{blockIdx.x} * kThreads + threadIdx.x;
  if (at >= in.count * in.joints) return;
  const int64_t i = at / in.joints, j = at % in.joints;
  float sum = 0.f;
  DYNGS_UNROLL
  for (int k = 0; k < kAffine; ++k) sum += global(by_blended)[kAffine * i + k] * global(in.transforms)[kAffine * j + k];
  global(out)[at] = sum;
}

// Sums over `run` Gaussians per block, of every number of the transforms.
__global__ void __launch_bounds__(kSumThreads)
    sum_run_kernel(Posing<float> in, const float* by_blended, int64_t run, float* partials) {
  const int64_t begin = int64_t{blockIdx.x} * run, end = begin + run < in.count ? begin + run : in.count;
  for (int64_t n = threadIdx.x; n < kAffine * in.joints; n += kSumThreads) {
    const int64_t j = n / kAffine, k = n % kAffine;
    float sum = 0.f;
    for (int64_t i = begin; i < end; ++i)
      sum += global(in.weights)[i * in.joints + j] * global(by_blended)[kAffine * i + k];
    global(partials)[int64_t{blockIdx.x} * kAffine * in.joints + n] = sum;
  }
}

// One block per number of the transforms.
__global__ void __launch_bounds__(kThreads) sum_runs_kernel(const float* partials, int64_t runs, float* out) {
  DYNGS_SHARED(double, warp_sums, kThreads / kWarpSize);
  double mine = 0;
  for (int64_t r = threadIdx.x; r < runs; r += kThreads)
    mine += static_cast<double>(static_cast<float>(global(partials)[r * gridDim.x + blockIdx.x]));
  const double sum = block_sum(mine, warp_sums);
  if (threadIdx.x == 0) global(out)[blockIdx.x] = static_cast<float>(sum);
}

int64_t run_length(int64_t count) {
  const int64_t fitting = blocks_for(count, kMostRuns);
  return fitting < kShortestRun ? kShortestRun : fitting;
}

}  // namespace

void pose_forward(const Posing<float>& in, const Posed<float>& out, Stream stream) {
  launch("pose", {blocks_for(in.count, kThreads), kThreads}, stream, pose_kernel, in, out);
}

int64_t pose_backward_workspace(int64_t count, int64_t joints) {
  Workspace w(nullptr, 0);
  w.take<float>(kAffine * count);
  w.take<float>(blocks_for(count, run_length(count)) * kAffine * joints);
  return w.taken();
}

void pose_backward(const Posing<float>& in, const Posed<const float>& posed, const PosedGrads<float>& g,
                   const PosingGrads<float>& out, const Lent& lent, Stream stream) {
  Workspace workspace(lent.memory, lent.bytes);
  const int64_t run = run_length(in.count), runs = blocks_for(in.count, run), numbers = kAffine * in.joints;
  float* by_blended = workspace.take<float>(kAffine * in.count);
  float* partials = workspace.take<float>(runs * numbers);
  launch("pose_backward", {blocks_for(in.count, kThreads), kThreads}, stream, pose_backward_kernel, in, posed, g, out,
         by_blended);
  const float* rows = by_blended;
  if (out.weights != nullptr)
    launch("by_weights", {blocks_for(in.count * in.joints, kThreads), kThreads}, stream, by_weights_kernel, in, rows,
           out.weights);
  launch("sum_run", {runs, kSumThreads}, stream, sum_run_kernel, in, rows, run, partials);
  launch("sum_runs", {numbers, kThreads}, stream, sum_runs_kernel, static_cast<const float*>(partials), runs,
         out.transforms);
}

}  // namespace dyngs::cuda
