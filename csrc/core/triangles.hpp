// The native interface of Bezier patches, as core/api.hpp is that of Gaussians. Shape letters: P patches, K values of each,
// C channels, N places on patches, V views of H by W pixels.
#pragma once

#include <cstdint>

#include "core/api.hpp"
#include "math/outline.hpp"

namespace dyngs {

struct PatchPlaces {
  const int32_t* ids;  // (N,) in [0, P)
  int64_t count;       // N
  int64_t patches;     // P
  int64_t values;      // K: 6, or of the lattice
  int64_t channels;    // C
  PatchBasis basis;
  int segments;  // of the lattice
  int threads;
};

// Writes (N, C): the values (P, K, C) of each place's patch at uv (N, 2).
template <class S>
void patch_values_forward(const PatchPlaces& places, const S* uv, const S* values, S* out);

// Writes the gradient (P, K, C) of sum(out * g_out) by the values.
template <class S>
void patch_values_backward(const PatchPlaces& places, const S* uv, const S* g_out, S* g_values);

template <class S>
struct PatchViews {
  const S* points;      // (P, 6, 3) control points, world
  const S* viewmats;    // (V, 4, 4) cam_from_world
  const S* intrinsics;  // (V, 3, 3) px
  int64_t patches, views;
  int width, height;
  int segments;  // n: a patch is drawn as n^2 flat faces, or as fewer where these are as good
  S near;        // what is nearer is not drawn
  int threads;
};

template <class S>
struct VisiblePatches {
  int32_t* ids;  // (V, H, W) of the nearest patch, of several as near the first; -1: none
  S* uv;         // (V, H, W, 2) where on it
};

// Both sides of patches are drawn. Those with a control point that is not finite are not.
template <class S>
void visible_patches(const PatchViews<S>& in, const VisiblePatches<S>& out);

// N places on patches from where outlines are looked for.
template <class S>
struct PatchSteps {
  const S* points;            // (P, 6, 3) control points, world
  const S* viewmats;          // (V, 4, 4) cam_from_world
  const S* intrinsics;        // (V, 3, 3) px
  const int32_t* views;       // (N,) in [0, V)
  const int32_t* ids;         // (N,) in [0, P), -1: no patch
  const int32_t* directions;  // (N,) to the next pixel, math/outline.hpp
  const S* uv;                // (N, 2)
  int64_t count;              // N
  int threads;
};

template <class S>
struct PatchEnds {
  bool* found;  // (N,) whether the patch ends before the next pixel; the rest is 0 where not
  S* steps;     // (N,) where, in [0, 1] of the way there
  S* uv;        // (N, 2) the place on its edge
  S* slopes;    // (N, 2) change of the steps by the mean of that place, px
};

template <class S>
void patch_ends(const PatchSteps<S>& in, const PatchEnds<S>& out);

template <class S>
struct PatchImage {
  const int32_t* rows;  // (V, H, W) row of what each pixel shows, -1: nothing
  const int32_t* ids;   // (N,) its patch
  const S* colours;     // (N, C)
  const S* crossings;   // (V, 2, H, W) where between a pixel and the next in its row, in its column, their outline is
  int64_t views;
  int64_t count;  // N
  int width, height, channels;
  int threads;
};

inline constexpr int kMostPatchChannels = 8;

template <class S>
struct BlendedPatches {
  S* image;          // (V, H, W, C), before black
  S* transmittance;  // (V, H, W)
};

template <class S>
struct PatchGrads {
  S* means;      // (N, 2) px
  S* colours;    // (N, C)
  S* crossings;  // (V, 2, H, W)
};

// Each pixel is the mean of what it shows and of what the four next to it show, by how much each covers of it
// (math/outline.hpp).
template <class S>
void blend_patches_forward(const PatchImage<S>& in, const BlendedPatches<S>& out);

// Gradients from those by image and transmittance. The means of the places are at the pixels' centres; their gradient is that of
// moving colours along, by differences of neighbours on the same patch.
template <class S>
void blend_patches_backward(const PatchImage<S>& in, const BlendedPatches<const S>& grads, const PatchGrads<S>& out);

// Gaussians that lie on patches, one per covered pixel of one view, for the weights of math/boundary.hpp.
template <class S>
struct Boundaries {
  const int32_t* rows;  // (H, W) Gaussian of each pixel, -1: none
  const int32_t* ids;   // (N,) its patch, not negative
  const S* samples;     // (N, 2) px; those of pixels with another patch beside them are on outlines
  S radius;             // px, positive
};

// As rasterize_forward and rasterize_backward, without tallies and probes; alpha is multiplied by the weight of the pixel and the
// Gaussian's patch. Writes the gradients (N, 2) by the samples, for which the nearest sample of each pixel is held constant. CPU.
template <class S>
void rasterize_bounded_forward(const Splats<S>& splats, const Entries& entries, const Boundaries<S>& boundaries,
                               const Image<S>& image);
template <class S>
void rasterize_bounded_backward(const Splats<S>& splats, const Entries& entries, const Boundaries<S>& boundaries,
                                const ImageGrads<S>& image, const SplatGrads<S>& out, S* g_samples);

}  // namespace dyngs
