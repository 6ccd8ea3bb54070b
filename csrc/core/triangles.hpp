// The native interface of Bezier patches, as core/api.hpp is that of Gaussians. Shape letters: P patches, K values of each,
// C channels, N places on patches, V views of H by W pixels.
#pragma once

#include <cstdint>

#include "math/bezier.hpp"

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
  int segments;  // n: a patch is drawn as n^2 flat faces
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

template <class S>
struct PatchImage {
  const int32_t* rows;  // (V, H, W) row of what each pixel shows, -1: nothing
  const int32_t* ids;   // (N,) its patch
  const S* means;       // (N, 2) px
  const S* colours;     // (N, C)
  int64_t views;
  int64_t count;  // N
  int width, height, channels;
  S sigma;   // of the Gaussians, px
  S radius;  // of outlines, px
  int threads;
};

inline constexpr int kMostPatchChannels = 8;

template <class S>
struct BlendedPatches {
  S* image;          // (V, H, W, C), before black
  S* transmittance;  // (V, H, W)
  S* sums;           // (V, H, W) of the weights, for the vjp
};

// Each pixel is the mean of the Gaussians of the pixels around it, weighted by their value there and by how much their patch
// counts there (math/outline.hpp). A pixel that shows nothing has a Gaussian of the background at its centre.
template <class S>
void blend_patches_forward(const PatchImage<S>& in, const BlendedPatches<S>& out);

// Gradients by means (N, 2) and colours (N, C) from those by image and transmittance.
template <class S>
void blend_patches_backward(const PatchImage<S>& in, const BlendedPatches<const S>& out, const S* g_image,
                            const S* g_transmittance, S* g_means, S* g_colours);

}  // namespace dyngs
