// Inputs of the network of compact colour (math/shading.hpp), one thread per row.
//
// Limits, H100 (3.35 TB/s): 72 bytes read and at most 56 written per row, about 120 operations: bound by memory, 38 ps per row.
// Neighbouring threads write rows of up to 14 numbers, which fill their sectors together.
#include "cuda/api.hpp"
#include "cuda/device.hpp"
#include "cuda/rows.hpp"
#include "math/shading.hpp"

namespace dyngs::cuda {
namespace {

constexpr int kThreads = 256;

// Writes numbers one after the other.
struct Row {
  Array<float> to;
  int next = 0;
  __device__ void put(float x) { to[next++] = x; }
  __device__ void put(const Vec3<float>& v) { put(v.x), put(v.y), put(v.z); }
};

__global__ void __launch_bounds__(kThreads) shading_kernel(Shading<float> in, int64_t width, float* out) {
  const int64_t m = int64_t{blockIdx.x} * kThreads + threadIdx.x;
  if (m >= in.rows) return;
  const int64_t i = global(in.picked)[m];
  Row row{global(out) + m * width};
  const Vec3<float> mean = load3(in.means, i), place = in.places != nullptr ? load3(in.places, i) : mean;
  const Vec3<float> center = load3(in.box, 0), half = load3(in.box, 1);
  row.put(
      contracted<float>({(place.x - center.x) / half.x, (place.y - center.y) / half.y, (place.z - center.z) / half.z}));
  Mat3<float> turn{};  // from rest to the world
  if (in.turn != nullptr)
    for (int k = 0; k < 9; ++k) turn.m[k / 3][k % 3] = global(in.turn)[k];
  float inv_norm;  // for a gradient, which is not needed
  Vec3<float> direction = normalize(mean - load3(in.eye, 0), inv_norm);
  if (in.turn != nullptr) direction = transposed_times(turn, direction);
  row.put(direction);
  if (in.normals) {
    const Array<const float> q = global(in.quats) + 4 * i;
    const Vec3<float> log_scales = load3(in.log_scales, i);
    const float of_axes[3] = {log_scales.x, log_scales.y, log_scales.z};
    Vec3<float> normal = shortest_axis(Quat<float>{q[0], q[1], q[2], q[3]}, of_axes);
    if (in.turn != nullptr) normal = transposed_times(turn, normal);
    const float cosine = dot(normal, direction);
    row.put(abs(cosine)), row.put(reflected(direction, normal, cosine));
  }
  const Vec3<float> base = load3(in.base, m);
  row.put({base.x - 0.5f, base.y - 0.5f, base.z - 0.5f});
  if (in.timed) row.put(in.time);
}

}  // namespace

void shading_inputs(const Shading<float>& in, float* out, Stream stream) {
  launch("shading", {blocks_for(in.rows, kThreads), kThreads}, stream, shading_kernel, in, in.width(), out);
}

}  // namespace dyngs::cuda
