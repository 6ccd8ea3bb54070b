// View-dependent colour (math/harmonics.hpp) and its backward pass, one thread per Gaussian, all views in a loop. A warp copies
// the coefficients of its Gaussians to shared memory row by row, so that it reads and writes whole lines, and none of
// Gaussians that no view sees.
//
// Limits, H100 (3.35 TB/s, 67 TFLOP/s), K = 16, one view. Forward, per Gaussian: 192 + 20 bytes read, 12 written, about 200
// operations: 67 ps of bandwidth, 3 ps of arithmetic: bound by memory, 1 M Gaussians no faster than 67 us. Backward: 192 + 44
// bytes read, 192 + 12 written: 131 ps against 6.
#include "cuda/api.hpp"
#include "cuda/reduce.hpp"
#include "math/harmonics.hpp"

namespace dyngs::cuda {
namespace {

constexpr int kThreads = 64;
constexpr int kWarps = kThreads / kWarpSize;

// Numbers from one row to the next in shared memory: odd, so that the lanes of a warp meet in no bank.
DYNGS_HD constexpr int row_stride(int numbers) { return numbers | 1; }

// Copies a warp's rows of `numbers` floats between global memory (from row `first`) and shared memory; those in `wanted`.
__device__ void load_rows(const Array<const float>& from, int64_t first, int numbers, uint32_t wanted,
                          const Array<float>& rows) {
  const int lane = static_cast<int>(threadIdx.x) % kWarpSize;
  for (; wanted != 0; wanted &= wanted - 1) {
    const int i = __ffs(static_cast<int>(wanted)) - 1;
    for (int k = lane; k < numbers; k += kWarpSize) rows[i * row_stride(numbers) + k] = from[(first + i) * numbers + k];
  }
}
__device__ void store_rows(const Array<const float>& rows, int64_t first, int numbers, uint32_t wanted,
                           const Array<float>& to) {
  const int lane = static_cast<int>(threadIdx.x) % kWarpSize;
  for (; wanted != 0; wanted &= wanted - 1) {
    const int i = __ffs(static_cast<int>(wanted)) - 1;
    for (int k = lane; k < numbers; k += kWarpSize) to[(first + i) * numbers + k] = rows[i * row_stride(numbers) + k];
  }
}

__device__ bool seen_in_any_view(const Harmonics<float>& in, int64_t i) {
  const Array<const int32_t> radii = global(in.radii);
  bool seen = false;
  for (int64_t view = 0; view < in.num_views; ++view) seen |= radii[2 * (view * in.num_gaussians + i)] > 0;
  return seen;
}

__device__ Vec3<float> direction(const Harmonics<float>& in, int64_t view, int64_t i, float& inv_norm) {
  const Array<const float> m = global(in.means) + 3 * i, c = global(in.centers) + 3 * view;
  return normalize(Vec3<float>{m[0] - c[0], m[1] - c[1], m[2] - c[2]}, inv_norm);
}

__global__ void __launch_bounds__(kThreads) harmonics_kernel(Harmonics<float> in, float* colors) {
  DYNGS_DYNAMIC_SHARED(float, shared);
  const int numbers = 3 * in.num_terms, terms = (in.degree + 1) * (in.degree + 1);
  const int thread = static_cast<int>(threadIdx.x), warp = thread / kWarpSize, lane = thread % kWarpSize;
  const int64_t i = int64_t{blockIdx.x} * kThreads + thread;
  const bool exists = i < in.num_gaussians;
  const uint32_t seen = __ballot_sync(kAllLanes, exists && seen_in_any_view(in, i));
  const Array<float> rows = shared + warp * kWarpSize * row_stride(numbers);
  load_rows(global(in.sh), i - lane, numbers, seen, rows);
  __syncwarp();
  if (!exists) return;
  const Array<const float> sh = rows + lane * row_stride(numbers);
  for (int64_t view = 0; view < in.num_views; ++view) {
    const int64_t row = view * in.num_gaussians + i;
    float rgb[3] = {0.f, 0.f, 0.f};
    if (global(in.radii)[2 * row] > 0) {
      float inv_norm, basis[kMaxShTerms];
      const Vec3<float> d = direction(in, view, i, inv_norm);
      sh_basis(in.degree, d.x, d.y, d.z, basis);
      for (int c = 0; c < 3; ++c) rgb[c] = 0.5f;
      DYNGS_UNROLL
      for (int k = 0; k < kMaxShTerms; ++k)
        if (k < terms)
          for (int c = 0; c < 3; ++c) rgb[c] += basis[k] * sh[3 * k + c];
    }
    for (int c = 0; c < 3; ++c) global(colors)[3 * row + c] = max(rgb[c], 0.f);
  }
}

// Adds one view's gradient to the row `g_sh`, and returns that by the ray from the camera to the Gaussian.
__device__ Vec3<float> add_view(const Harmonics<float>& in, int64_t view, int64_t i, const float (&g)[3],
                                const Array<const float>& sh, const Array<float>& g_sh) {
  const int terms = (in.degree + 1) * (in.degree + 1);
  float inv_norm, basis[kMaxShTerms], weight[kMaxShTerms];
  const Vec3<float> d = direction(in, view, i, inv_norm);
  sh_basis(in.degree, d.x, d.y, d.z, basis);
  DYNGS_UNROLL
  for (int k = 0; k < kMaxShTerms; ++k) {
    if (k >= terms) continue;
    weight[k] = 0.f;
    for (int c = 0; c < 3; ++c) {
      g_sh[3 * k + c] += basis[k] * g[c];
      weight[k] += sh[3 * k + c] * g[c];
    }
  }
  if (in.degree == 0) return {};
  Vec3<float> by_unit;
  sh_basis_vjp(in.degree, d.x, d.y, d.z, weight, by_unit.x, by_unit.y, by_unit.z);
  return normalize_vjp(d, inv_norm, by_unit);
}

struct HarmonicsGrads {
  const float *colors, *grad_colors;  // (V, N, 3)
  float *means, *sh;                  // (N, 3), (N, K, 3)
  double* partials;                   // (blocks, V, 3): of the camera centres, per block; or null
};

__global__ void __launch_bounds__(kThreads) harmonics_backward_kernel(Harmonics<float> in, HarmonicsGrads grads) {
  DYNGS_DYNAMIC_SHARED(float, shared);
  DYNGS_SHARED(double, warp_sums, kWarps);
  const int numbers = 3 * in.num_terms, stride = row_stride(numbers);
  const int thread = static_cast<int>(threadIdx.x), warp = thread / kWarpSize, lane = thread % kWarpSize;
  const int64_t i = int64_t{blockIdx.x} * kThreads + thread;
  const bool exists = i < in.num_gaussians;
  const uint32_t existing = __ballot_sync(kAllLanes, exists);
  const uint32_t seen = __ballot_sync(kAllLanes, exists && seen_in_any_view(in, i));
  const Array<float> rows = shared + 2 * warp * kWarpSize * stride, g_rows = rows + kWarpSize * stride;
  load_rows(global(in.sh), i - lane, numbers, seen, rows);
  for (int k = 0; k < numbers; ++k) g_rows[lane * stride + k] = 0.f;
  __syncwarp();
  Vec3<float> by_mean{};
  for (int64_t view = 0; view < in.num_views; ++view) {
    const int64_t row = view * in.num_gaussians + i;
    Vec3<float> by_ray{};
    if (exists && global(in.radii)[2 * row] > 0) {
      float g[3];
      for (int c = 0; c < 3; ++c)  // the clamp stops the gradient
        g[c] =
            global(grads.colors)[3 * row + c] > 0.f ? static_cast<float>(global(grads.grad_colors)[3 * row + c]) : 0.f;
      if (g[0] != 0.f || g[1] != 0.f || g[2] != 0.f)
        by_ray = add_view(in, view, i, g, rows + lane * stride, g_rows + lane * stride);
    }
    by_mean = by_mean + by_ray;
    if (grads.partials == nullptr) continue;
    for (int c = 0; c < 3; ++c) {
      const double total = block_sum(-static_cast<double>(by_ray[c]), warp_sums);
      if (thread == 0) global(grads.partials)[(int64_t{blockIdx.x} * in.num_views + view) * 3 + c] = total;
    }
  }
  __syncwarp();
  store_rows(g_rows, i - lane, numbers, existing, global(grads.sh));
  if (!exists) return;
  for (int c = 0; c < 3; ++c) global(grads.means)[3 * i + c] = by_mean[c];
}

// One thread per number of grad_centers (V, 3).
__global__ void sum_centers_kernel(const double* partials, int64_t blocks, int64_t numbers, float* grad_centers) {
  const int64_t k = int64_t{blockIdx.x} * blockDim.x + threadIdx.x;
  if (k >= numbers) return;
  double total = 0;
  for (int64_t b = 0; b < blocks; ++b) total += global(partials)[b * numbers + k];
  global(grad_centers)[k] = static_cast<float>(total);
}

}  // namespace

void harmonics_forward(const Harmonics<float>& in, float* colors, Stream stream) {
  const int64_t bytes = int64_t{kThreads} * row_stride(3 * in.num_terms) * int64_t{sizeof(float)};
  launch("harmonics", {blocks_for(in.num_gaussians, kThreads), kThreads, bytes}, stream, harmonics_kernel, in, colors);
}

int64_t harmonics_backward_workspace(int64_t num_gaussians, int64_t num_views) {
  return blocks_for(num_gaussians, kThreads) * num_views * 3 * int64_t{sizeof(double)};
}

void harmonics_backward(const Harmonics<float>& in, const float* colors, const float* grad_colors, float* grad_means,
                        float* grad_sh, float* grad_centers, const Lent& workspace, Stream stream) {
  const int64_t blocks = blocks_for(in.num_gaussians, kThreads), numbers = 3 * in.num_views;
  const int64_t bytes = int64_t{kThreads} * 2 * row_stride(3 * in.num_terms) * int64_t{sizeof(float)};
  double* partials = nullptr;
  if (grad_centers != nullptr) partials = Workspace(workspace.memory, workspace.bytes).take<double>(blocks * numbers);
  launch("harmonics_backward", {blocks, kThreads, bytes}, stream, harmonics_backward_kernel, in,
         HarmonicsGrads{colors, grad_colors, grad_means, grad_sh, partials});
  if (grad_centers == nullptr) return;
  launch("sum_centers", {blocks_for(numbers, kThreads), kThreads}, stream, sum_centers_kernel,
         static_cast<const double*>(partials), blocks, numbers, grad_centers);
}

}  // namespace dyngs::cuda
