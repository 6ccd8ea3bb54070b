// Outlines of patches between neighbouring pixels. Each sample is written by one task.
#include "core/triangles.hpp"
#include "cpu/parallel.hpp"

namespace dyngs {
namespace {

constexpr int64_t kGrain = 256;  // places

template <class S>
[[gnu::noinline]] PatchEnd<S> end_from(const PatchSteps<S>& in, int64_t n) {
  if (in.ids[n] < 0) return {};
  const int64_t view = in.views[n];
  const Pinhole<S> cam = pinhole(in.viewmats + 16 * view, in.intrinsics + 9 * view, 0, 0);
  const S* control = in.points + 3 * kPatchPoints * in.ids[n];
  const PatchEnd<S> end = patch_end(cam, control, in.uv[2 * n], in.uv[2 * n + 1], in.directions[n]);
  return end.is_found ? end : PatchEnd<S>{};
}

}  // namespace

template <class S>
void patch_ends(const PatchSteps<S>& in, const PatchEnds<S>& out) {
  parallel_for(in.count, kGrain, in.threads, [&](int64_t begin, int64_t end) {
    for (int64_t n = begin; n < end; ++n) {
      const PatchEnd<S> found = end_from(in, n);
      out.found[n] = found.is_found, out.steps[n] = found.t;
      out.uv[2 * n] = found.u, out.uv[2 * n + 1] = found.v;
      out.slopes[2 * n] = found.slope.x, out.slopes[2 * n + 1] = found.slope.y;
    }
  });
}

template void patch_ends<float>(const PatchSteps<float>&, const PatchEnds<float>&);
template void patch_ends<double>(const PatchSteps<double>&, const PatchEnds<double>&);

}  // namespace dyngs
