// Offsets of a deformation field, added to Gaussians in place, one thread per row.
//
// Limits, H100 (3.35 TB/s): 56 bytes of offsets read, 112 of Gaussians read and written, 8 of the row's number; about 40
// operations: bound by memory, 53 ps per row where neighbours in `rows` are neighbours in memory, else up to twice that.
#include "cuda/api.hpp"
#include "cuda/device.hpp"
#include "cuda/rows.hpp"
#include "math/quaternion.hpp"

namespace dyngs::cuda {
namespace {

constexpr int kThreads = 256;

__device__ void add3(const Array<float>& to, const Array<const float>& by) {
  for (int c = 0; c < 3; ++c) to[c] += by[c];
}

__device__ void turn(const Array<float>& q, const Array<const float>& by) {
  const Quat<float> turned = Quat<float>{by[0] + 1.f, by[1], by[2], by[3]} * Quat<float>{q[0], q[1], q[2], q[3]};
  q[0] = turned.w, q[1] = turned.x, q[2] = turned.y, q[3] = turned.z;
}

__global__ void __launch_bounds__(kThreads) add_offsets_kernel(RowOffsets<float> offsets, MovedGaussians<float> g) {
  const int64_t i = int64_t{blockIdx.x} * kThreads + threadIdx.x;
  if (i >= offsets.count) return;
  const int64_t row = offsets.rows != nullptr ? static_cast<int64_t>(global(offsets.rows)[i]) : i;
  add3(global(g.means) + 3 * row, global(offsets.means) + 3 * i);
  if (offsets.quats != nullptr) turn(global(g.quats) + 4 * row, global(offsets.quats) + 4 * i);
  if (offsets.log_scales != nullptr) add3(global(g.log_scales) + 3 * row, global(offsets.log_scales) + 3 * i);
  if (offsets.logit_opacities != nullptr)
    global(g.logit_opacities)[row] += static_cast<float>(global(offsets.logit_opacities)[i]);
  if (offsets.colors != nullptr) add3(global(g.sh) + g.sh_stride * row, global(offsets.colors) + 3 * i);
}

__device__ void put3(const Array<float>& to, const Array<const float>& from) {
  for (int c = 0; c < 3; ++c) to[c] = static_cast<float>(from[c]);
}

__global__ void __launch_bounds__(kThreads)
    add_offsets_backward_kernel(RowOffsets<float> offsets, const float* quats, OffsetGrads<float> g) {
  const int64_t i = int64_t{blockIdx.x} * kThreads + threadIdx.x;
  if (i >= offsets.count) return;
  const int64_t row = offsets.rows != nullptr ? static_cast<int64_t>(global(offsets.rows)[i]) : i;
  if (g.by_means != nullptr) put3(global(g.by_means) + 3 * i, global(g.means) + 3 * row);
  if (g.by_log_scales != nullptr) put3(global(g.by_log_scales) + 3 * i, global(g.log_scales) + 3 * row);
  if (g.by_logit_opacities != nullptr)
    global(g.by_logit_opacities)[i] = static_cast<float>(global(g.logit_opacities)[row]);
  if (g.by_colors != nullptr) put3(global(g.by_colors) + 3 * i, global(g.sh) + g.sh_stride * row);
  if (g.by_quats == nullptr) return;
  const Quat<float> by = load4(g.quats, row), offset = load4(offsets.quats, i);
  store4(g.by_quats, i, by * conjugate(load4(quats, row)));
  store4(g.quats, row, conjugate(Quat<float>{offset.w + 1.f, offset.x, offset.y, offset.z}) * by);
}

}  // namespace

void add_offsets_backward(const RowOffsets<float>& offsets, const float* quats, const OffsetGrads<float>& grads,
                          Stream stream) {
  launch("add_offsets_backward", {blocks_for(offsets.count, kThreads), kThreads}, stream, add_offsets_backward_kernel,
         offsets, quats, grads);
}

void add_offsets(const RowOffsets<float>& offsets, const MovedGaussians<float>& gaussians, Stream stream) {
  launch("add_offsets", {blocks_for(offsets.count, kThreads), kThreads}, stream, add_offsets_kernel, offsets,
         gaussians);
}

}  // namespace dyngs::cuda
