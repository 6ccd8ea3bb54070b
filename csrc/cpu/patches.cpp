// Values of Bezier patches and of lattices on them at many places. Each place, and in the vjp each patch, is one task's.
#include <algorithm>
#include <vector>

#include "core/triangles.hpp"
#include "cpu/parallel.hpp"

namespace dyngs {
namespace {

constexpr int64_t kGrain = 1024;      // places
constexpr int64_t kPatchGrain = 128;  // patches

template <class S>
PatchWeights<S> weights_at(const PatchPlaces& places, const S* uv, int64_t n) {
  return patch_weights(places.basis, places.segments, uv[2 * n], uv[2 * n + 1]);
}

// The places of each patch, in their order: those of patch p are places[starts[p]] to before places[starts[p + 1]].
struct PlacesOfPatches {
  std::vector<int64_t> starts, places;

  explicit PlacesOfPatches(const PatchPlaces& in) : starts(in.patches + 2), places(in.count) {
    for (int64_t n = 0; n < in.count; ++n) ++starts[in.ids[n] + 2];
    for (int64_t p = 0; p < in.patches; ++p) starts[p + 2] += starts[p + 1];
    for (int64_t n = 0; n < in.count; ++n) places[starts[in.ids[n] + 1]++] = n;
  }
};

}  // namespace

template <class S>
void patch_values_forward(const PatchPlaces& places, const S* uv, const S* values, S* out) {
  const int64_t channels = places.channels;
  parallel_for(places.count, kGrain, places.threads, [&](int64_t begin, int64_t end) {
    for (int64_t n = begin; n < end; ++n) {
      const PatchWeights<S> at = weights_at(places, uv, n);
      const S* from = values + places.ids[n] * places.values * channels;
      S* to = out + n * channels;
      std::fill_n(to, channels, S(0));
      for (int k = 0; k < at.count; ++k) {
        for (int64_t c = 0; c < channels; ++c) to[c] += at.weight[k] * from[at.index[k] * channels + c];
      }
    }
  });
}

template <class S>
void patch_values_backward(const PatchPlaces& places, const S* uv, const S* g_out, S* g_values) {
  const int64_t channels = places.channels, size = places.values * channels;
  const PlacesOfPatches sorted(places);
  parallel_for(places.patches, kPatchGrain, places.threads, [&](int64_t begin, int64_t end) {
    for (int64_t p = begin; p < end; ++p) {
      S* to = g_values + p * size;
      std::fill_n(to, size, S(0));
      for (int64_t i = sorted.starts[p]; i < sorted.starts[p + 1]; ++i) {
        const int64_t n = sorted.places[i];
        const PatchWeights<S> at = weights_at(places, uv, n);
        for (int k = 0; k < at.count; ++k) {
          for (int64_t c = 0; c < channels; ++c)
            to[at.index[k] * channels + c] += at.weight[k] * g_out[n * channels + c];
        }
      }
    }
  });
}

#define DYNGS_INSTANTIATE(S)                                                         \
  template void patch_values_forward<S>(const PatchPlaces&, const S*, const S*, S*); \
  template void patch_values_backward<S>(const PatchPlaces&, const S*, const S*, S*);
DYNGS_INSTANTIATE(float)
DYNGS_INSTANTIATE(double)
#undef DYNGS_INSTANTIATE

}  // namespace dyngs
