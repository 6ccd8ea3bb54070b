// Values at places on Bezier patches, and where patches end: one thread per place. Backward the places are sorted by patch,
// stably, and one thread adds up what comes to a value of a patch, in their order: no atomics, the sums of the CPU.
//
// Limits, H100 (3.35 TB/s). Per place with three channels: 24 bytes and the rows of its patch, which neighbours share: 7 to 30 ps.
// Backward three passes of the sort at 20 bytes and the gradient: 26 ps; a patch that fills the image, of P pixels, is 18 threads'
// work of P reads that all share, some 2 ns each: 1 ms for 500,000.
#include "cuda/api.hpp"
#include "cuda/camera.hpp"
#include "cuda/device.hpp"
#include "cuda/sort.hpp"

namespace dyngs::cuda {
namespace {

constexpr int kThreads = 128;

__device__ int64_t this_thread() { return int64_t{blockIdx.x} * kThreads + threadIdx.x; }

__device__ PatchWeights<float> weights_at(const PatchPlaces& places, const float* uv, int64_t n) {
  const float u = global(uv)[2 * n], v = global(uv)[2 * n + 1];
  return patch_weights(places.basis, places.segments, u, v);
}

__global__ void __launch_bounds__(kThreads)
    patch_values_kernel(PatchPlaces places, const float* uv, const float* values, float* out) {
  const int64_t n = this_thread(), channels = places.channels;
  if (n >= places.count) return;
  const PatchWeights<float> at = weights_at(places, uv, n);
  const Array<const float> from = global(values) + int64_t{global(places.ids)[n]} * places.values * channels;
  for (int64_t c = 0; c < channels; ++c) {
    float sum = 0.f;
    for (int k = 0; k < at.count; ++k) sum += at.weight[k] * from[at.index[k] * channels + c];
    global(out)[n * channels + c] = sum;
  }
}

__global__ void __launch_bounds__(kThreads) patch_pairs_kernel(PatchPlaces places, Pairs pairs) {
  const int64_t n = this_thread();
  if (n >= places.count) return;
  global(pairs.keys)[n] = static_cast<uint32_t>(static_cast<int32_t>(global(places.ids)[n]));
  global(pairs.values)[n] = static_cast<int32_t>(n);
}

// One thread for each value and channel of each patch.
__global__ void __launch_bounds__(kThreads)
    gather_values_kernel(PatchPlaces places, const float* uv, const int32_t* sorted, const int32_t* offsets,
                         const float* g_out, float* g_values) {
  const int64_t i = this_thread(), size = places.values * places.channels;
  if (i >= places.patches * size) return;
  const int64_t patch = i / size, value = i % size / places.channels, channel = i % places.channels;
  const int64_t end = global(offsets)[patch + 1];
  float sum = 0.f;
  for (int64_t k = global(offsets)[patch]; k < end; ++k) {
    const int64_t n = global(sorted)[k];
    const PatchWeights<float> at = weights_at(places, uv, n);
    for (int j = 0; j < at.count; ++j) {
      if (at.index[j] == value) sum += at.weight[j] * global(g_out)[n * places.channels + channel];
    }
  }
  global(g_values)[i] = sum;
}

struct ValueBuffers {
  Pairs pairs, other;
  int32_t* offsets;
  SortScratch sort;
  ValueBuffers(Workspace& w, const PatchPlaces& places)
      : pairs{w.take<uint32_t>(places.count), w.take<int32_t>(places.count)},
        other{w.take<uint32_t>(places.count), w.take<int32_t>(places.count)},
        offsets(w.take<int32_t>(places.patches + 1)),
        sort(w, places.count) {}
};

__global__ void __launch_bounds__(kThreads, 4) patch_ends_kernel(PatchSteps<float> in, PatchEnds<float> out) {
  const int64_t n = this_thread();
  if (n >= in.count) return;
  const int32_t id = global(in.ids)[n];
  PatchEnd<float> end{};
  if (id >= 0) {
    const int64_t view = global(in.views)[n];
    const Pinhole<float> cam = load_camera<float>(in.viewmats, in.intrinsics, view, 0, 0);
    const Array<const float> control = global(in.points) + int64_t{3 * kPatchPoints} * id;
    const float u = global(in.uv)[2 * n], v = global(in.uv)[2 * n + 1];
    const PatchEnd<float> found = patch_end(cam, control, u, v, static_cast<int32_t>(global(in.directions)[n]));
    if (found.is_found) end = found;
  }
  global(out.found)[n] = end.is_found;
  global(out.steps)[n] = end.t;
  global(out.uv)[2 * n] = end.u;
  global(out.uv)[2 * n + 1] = end.v;
  global(out.slopes)[2 * n] = end.slope.x;
  global(out.slopes)[2 * n + 1] = end.slope.y;
}

}  // namespace

void patch_values_forward(const PatchPlaces& places, const float* uv, const float* values, float* out, Stream stream) {
  launch("patch_values", {blocks_for(places.count, kThreads), kThreads}, stream, patch_values_kernel, places, uv,
         values, out);
}

int64_t patch_values_backward_workspace(const PatchPlaces& places) {
  Workspace w(nullptr, 0);
  const ValueBuffers buffers(w, places);
  return w.taken();
}

void patch_values_backward(const PatchPlaces& places, const float* uv, const float* g_out, float* g_values,
                           const Lent& lent, Stream stream) {
  Workspace workspace(lent.memory, lent.bytes);
  const ValueBuffers b(workspace, places);
  launch("patch_pairs", {blocks_for(places.count, kThreads), kThreads}, stream, patch_pairs_kernel, places, b.pairs);
  const Pairs& sorted = stable_sort(b.pairs, b.other, places.count, bits_for(places.patches), b.sort, stream);
  find_offsets(sorted.keys, places.count, places.patches, b.offsets, stream);
  const int64_t total = places.patches * places.values * places.channels;
  launch("gather_values", {blocks_for(total, kThreads), kThreads}, stream, gather_values_kernel, places, uv,
         static_cast<const int32_t*>(sorted.values), static_cast<const int32_t*>(b.offsets), g_out, g_values);
}

void patch_ends(const PatchSteps<float>& in, const PatchEnds<float>& out, Stream stream) {
  launch("patch_ends", {blocks_for(in.count, kThreads), kThreads}, stream, patch_ends_kernel, in, out);
}

}  // namespace dyngs::cuda
