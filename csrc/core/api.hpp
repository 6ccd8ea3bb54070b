// The native interface, one struct per stage: raw pointers into caller-owned, contiguous, row-major arrays. Shape
// letters: V views, N Gaussians, K SH terms, D channels, H W pixels, E tile entries. Templates over float and double.
#pragma once

#include <cstdint>
#include <vector>

namespace dyngs {

inline constexpr int kTile = 16;          // tile side, px
inline constexpr int kMaxChannels = 40;   // D at most
inline constexpr int kMaxSide = 1 << 23;  // W, H at most: float32 has no pixel centres beyond

template <class S>
struct GaussianViews {
  int64_t num_gaussians, num_views;
  const S* means;       // (N, 3) world
  const S* quats;       // (N, 4) wxyz, any norm
  const S* scales;      // (N, 3) world, >= 0
  const S* opacities;   // (N,)
  const S* viewmats;    // (V, 4, 4) cam_from_world
  const S* intrinsics;  // (V, 3, 3) px
};

template <class S>
struct ProjectOptions {
  int width, height;
  S eps2d;          // low-pass variance, px^2
  S near, far;      // world units
  S alpha_min;      // pixels below it are not drawn: sets the extent
  S radius_clip;    // px; Gaussians not larger are culled
  bool antialiased;  // the extent uses the compensated opacity
  int threads;
};

template <class S>
struct Projected {
  S* means2d;        // (V, N, 2) px
  S* depths;         // (V, N) view-space z
  S* factors;        // (V, N, 3) U W V of the conic's square root, 1/px
  S* compensations;  // (V, N)
  int32_t* radii;    // (V, N, 2) half extents in px, 0 = culled
};

template <class S>
struct ProjectedGrads {
  const S *means2d, *depths, *factors, *compensations;
};

template <class S>
struct GaussianGrads {
  S* means;      // (N, 3)
  S* quats;      // (N, 4)
  S* scales;     // (N, 3)
  S* viewmats;   // (V, 4, 4) or null
};

template <class S>
struct Harmonics {
  int64_t num_gaussians, num_views;
  int num_terms;        // K stored
  int degree;           // used: (degree + 1)^2 <= K
  const S* means;       // (N, 3)
  const S* centers;     // (V, 3) camera centres
  const S* sh;          // (N, K, 3)
  const int32_t* radii; // (V, N, 2); culled Gaussians are skipped
  int threads;
};

// Where each Gaussian meets each tile, sorted by (view, tile, depth, index).
struct Binning {
  std::vector<int64_t> tile_offsets;   // (V * tiles + 1)
  std::vector<int32_t> slot_ranges;    // (V * N, 2) begin and end: the slots of one Gaussian are contiguous
  std::vector<int32_t> gaussians;      // (E,) view * N + gaussian
  std::vector<int32_t> slots;          // (E,) the entry's own place in a buffer ordered by Gaussian
};

template <class S>
struct Splats {
  int64_t num_gaussians, num_views;
  int width, height;
  int channels;             // D
  const S* means2d;         // (V, N, 2)
  const S* factors;         // (V, N, 3)
  const S* opacities;       // (V, N)
  const S* depths;          // (V, N), only for binning
  const S* colors;          // (V, N, D), not for binning
  const int32_t* radii;     // (V, N, 2)
  S alpha_min, alpha_max, transmittance_min;
  int threads;
};

struct Entries {
  const int64_t* tile_offsets;
  const int32_t* slot_ranges;
  const int32_t* gaussians;
  const int32_t* slots;
  int64_t count;
};

// What is summed per Gaussian besides drawing.
enum class Tally {
  kNone,
  kWeights,  // alpha T: its share of the picture
  kPixels,   // pixels that it was blended into
  kLanes,    // pixels that were computed for it, blended or not
  kSquaredSlopes,  // squares of d(sum of channels) / dG, G the 2D Gaussian's value at the pixel, before its opacity
};

template <class S>
struct Image {
  S* color;               // (V, H, W, D), background composited
  S* transmittance;       // (V, H, W)
  int32_t* stop;          // (V, H, W) entry of the tile at which the pixel was full
  const S* background;    // (V, D) or null
  S* tally;               // (V, N), or null with Tally::kNone
  Tally tallied;
};

template <class S>
struct ImageGrads {
  const S* color;          // (V, H, W, D)
  const S* transmittance;  // (V, H, W)
  const S* final_transmittance;  // (V, H, W), from the forward pass
  const int32_t* stop;
  const S* background;     // (V, D) or null
};

template <class S>
struct SplatGrads {
  S* means2d;    // (V, N, 2)
  S* factors;    // (V, N, 3)
  S* opacities;  // (V, N)
  S* colors;     // (V, N, D)
  S* probe;      // (V, N, 4): signed, then (if absolute) summed absolute gradient of the 2D means; or null
  bool absolute;
};

}  // namespace dyngs
