// The native interface: every op, forward and backward, and the structs of its arguments. Pointers are to caller-owned,
// contiguous, row-major arrays, of the device for which the library was built. Shape letters: V views, N Gaussians,
// K SH terms, D channels, H W pixels, E tile entries, M points or rows, S control nodes, B nodes per point, J joints,
// L plane levels, C plane channels. Templates over S = float and double. Outputs are written in full unless said otherwise,
// and no result depends on the number of threads.
#pragma once

#include <cstdint>
#include <span>
#include <vector>

namespace dyngs {

inline constexpr int kTile = 16;          // tile side, px
inline constexpr int kMaxChannels = 40;   // D at most
inline constexpr int kMaxSide = 1 << 23;  // W, H at most: float32 has no pixel centres beyond

// Projection ----------------------------------------------------------------------------------------------------------

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
  S eps2d;           // low-pass variance, px^2
  S near, far;       // world units
  S alpha_min;       // pixels below it are not drawn: sets the extent
  S radius_clip;     // px; Gaussians not larger are culled
  bool antialiased;  // the extent uses the compensated opacity
  int threads;
};

template <class S>
struct Projected {
  S* means2d;        // (V, N, 2) px
  S* depths;         // (V, N) view-space z
  S* factors;        // (V, N, 3) U W V of the conic's square root, 1/px (math/covariance.hpp)
  S* compensations;  // (V, N)
  int32_t* radii;    // (V, N, 2) half extents in px, 0 = culled
};

template <class S>
struct ProjectedGrads {
  const S *means2d, *depths, *factors, *compensations;  // shapes of Projected
};

template <class S>
struct GaussianGrads {
  S* means;       // (N, 3)
  S* quats;       // (N, 4)
  S* scales;      // (N, 3)
  S* viewmats;    // (V, 4, 4); null: neither these nor the intrinsics
  S* intrinsics;  // (V, 3, 3), 0 but for fx, fy, cx, cy; null where viewmats is
};

// Means, shapes and extents of N Gaussians in V images; zeros where culled.
template <class S>
void project_forward(const GaussianViews<S>& in, const ProjectOptions<S>& options, const Projected<S>& out);

// Gradients by Gaussians and cameras from those by the projection; `radii` (V, N, 2) comes from the forward pass.
template <class S>
void project_backward(const GaussianViews<S>& in, const ProjectOptions<S>& options, const int32_t* radii,
                      const ProjectedGrads<S>& grads, const GaussianGrads<S>& out);

// Spherical harmonics -------------------------------------------------------------------------------------------------

template <class S>
struct Harmonics {
  int64_t num_gaussians, num_views;
  int num_terms;         // K stored
  int degree;            // used: (degree + 1)^2 <= K
  const S* means;        // (N, 3)
  const S* centers;      // (V, 3) camera centres
  const S* sh;           // (N, K, 3)
  const int32_t* radii;  // (V, N, 2); culled Gaussians are skipped
  int threads;
};

// Writes colours (V, N, 3): max(0, sum_k sh_k Y_k(direction from the camera) + 0.5), 0 where culled.
template <class S>
void harmonics_forward(const Harmonics<S>& in, S* colors);

// Gradients (N, 3), (N, K, 3), (V, 3); grad_centers may be null. `colors` (V, N, 3) comes from the forward pass.
template <class S>
void harmonics_backward(const Harmonics<S>& in, const S* colors, const S* grad_colors, S* grad_means, S* grad_sh,
                        S* grad_centers);

// Rasterization -------------------------------------------------------------------------------------------------------

template <class S>
struct Splats {
  int64_t num_gaussians, num_views;
  int width, height;
  int channels;          // D
  const S* means2d;      // (V, N, 2)
  const S* factors;      // (V, N, 3)
  const S* opacities;    // (V, N)
  const S* depths;       // (V, N), only for binning
  const S* colors;       // (V, N, D), not for binning
  const int32_t* radii;  // (V, N, 2)
  S alpha_min, alpha_max, transmittance_min;
  int threads;

  // Of all views.
  int64_t tiles() const { return num_views * ((width + kTile - 1) / kTile) * int64_t{(height + kTile - 1) / kTile}; }
};

// The tiles that each Gaussian may be seen in, sorted by (view, tile, depth, index).
struct Binning {
  std::vector<int64_t> tile_offsets;  // (V * tiles + 1)
  std::vector<int32_t> slot_ranges;   // (V * N, 2) begin and end: the slots of one Gaussian are contiguous
  std::vector<int32_t> gaussians;     // (E,) view * N + gaussian
  std::vector<int32_t> slots;         // (E,) the entry's own place in a buffer ordered by Gaussian
};

// The same arrays, wherever they lie.
struct Entries {
  const int64_t* tile_offsets;
  const int32_t* slot_ranges;
  const int32_t* gaussians;
  const int32_t* slots;
  int64_t count;  // E
};

// A sum per Gaussian that is taken while drawing. The numbers are those of dyngs/ops.
enum class Tally {
  kNone,
  kWeights,        // alpha T: its share of the image
  kPixels,         // pixels that it was blended into
  kLanes,          // pixels that were computed for it, blended or not
  kSquaredSlopes,  // squares of d(sum of channels) / dG, G the 2D Gaussian's value at the pixel, before its opacity
};

template <class S>
struct Image {
  S* color;             // (V, H, W, D), background composited
  S* transmittance;     // (V, H, W)
  int32_t* stop;        // (V, H, W) entry of the tile at which the pixel was full
  const S* background;  // (V, D) or null
  S* tally;             // (V, N), or null with Tally::kNone
  Tally tallied;
};

template <class S>
struct ImageGrads {
  const S* color;                // (V, H, W, D)
  const S* transmittance;        // (V, H, W)
  const S* final_transmittance;  // (V, H, W), from the forward pass
  const int32_t* stop;           // (V, H, W), likewise
  const S* background;           // (V, D) or null
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

// Throws std::length_error with the numbers if more than `max_entries` would be needed, before allocating them.
template <class S>
Binning bin_tiles(const Splats<S>& splats, int64_t max_entries);

// Blends all tiles front to back.
template <class S>
void rasterize_forward(const Splats<S>& splats, const Entries& entries, const Image<S>& image);

// Gradients by the splats from those by the image.
template <class S>
void rasterize_backward(const Splats<S>& splats, const Entries& entries, const ImageGrads<S>& image,
                        const SplatGrads<S>& out);

// Factored space-time grids -------------------------------------------------------------------------------------------
// HexPlane (Cao and Johnson 2023), K-Planes (Fridovich-Keil et al. 2023), as 4DGS (Wu et al. 2024) uses them: three planes
// over space and three over time per level, multiplied; levels concatenated.

// Channels last. The first axis of a name is the fast one: `space` holds xy, xz, yz with rows y, z, z; `time` holds
// xt, yt, zt with rows t.
template <class S>
struct PlaneLevel {
  const S* space;  // (3, size, size, C)
  const S* time;   // (3, times, size, C)
  int64_t size;
  int64_t times;
};

template <class S>
struct PlaneGrads {  // shapes of PlaneLevel
  S* space;
  S* time;
};

template <class S>
struct HexPlane {
  std::span<const PlaneLevel<S>> levels;  // (L)
  int64_t channels;                       // C
  double time;                            // in [0, 1]
};

template <class S>
struct PlanePoints {
  const S* coords;  // (M, 3) in [-1, 1]; coordinates outside are clamped, NaN gives NaN
  int64_t count;
};

// Writes features (M, L * C), and into `order` (M) a permutation that puts neighbours next to each other.
template <class S>
void hexplane_forward(const HexPlane<S>& planes, const PlanePoints<S>& points, S* features, int32_t* order,
                      int threads);

// Gradients of sum(features * g_features), by the planes and, unless null, the points (M, 3). `order` comes from the
// forward pass.
template <class S>
void hexplane_backward(const HexPlane<S>& planes, const PlanePoints<S>& points, const int32_t* order,
                       const S* g_features, std::span<const PlaneGrads<S>> grads, S* g_coords, int threads);

struct PenaltyWeights {
  double space;  // of the mean squared second difference along the two axes of space planes, averaged over the axes
  double time;   // of that along the time axis of time planes
  double one;    // of the mean of |1 - plane| of time planes
};

// Sum over all planes of the weighted penalties. Writes its gradient into `grads` unless that is empty.
template <class S>
double plane_penalty(const HexPlane<S>& planes, const PenaltyWeights& weights, std::span<const PlaneGrads<S>> grads,
                     int threads);

// Perceptron ----------------------------------------------------------------------------------------------------------

// ReLU after every layer but the last. Layer l maps in(l) to out(l) features: y = W h + b.
template <class S>
struct Perceptron {
  std::span<const int64_t> widths;  // of the input, then of every layer; each at least 1
  int64_t skip;                     // layer whose input is the hidden activations followed by x, or 0 for none
  const S* params;                  // for every layer the weight (out, in), then the bias (out)
  int threads;

  int64_t layers() const { return static_cast<int64_t>(widths.size()) - 1; }
  int64_t hidden(int64_t l) const { return widths[l]; }
  int64_t in(int64_t l) const { return widths[l] + (l > 0 && l == skip ? widths[0] : 0); }
  int64_t out(int64_t l) const { return widths[l + 1]; }
  int64_t num_params() const {
    int64_t count = 0;
    for (int64_t l = 0; l < layers(); ++l) count += out(l) * (in(l) + 1);
    return count;
  }
  // Scalars per row that the forward pass can keep for the backward pass: the padded inputs of all layers but the first.
  int64_t kept_per_row() const;
};

// Writes y (M, out). `kept` receives M * kept_per_row() scalars, or is null.
template <class S>
void perceptron_forward(const Perceptron<S>& net, int64_t rows, const S* x, S* y, S* kept);

// Gradients by x (M, in), unless that is null, and by params. `kept` is what forward wrote, or null: the activations are
// then computed again, to the same bits.
template <class S>
void perceptron_backward(const Perceptron<S>& net, int64_t rows, const S* x, const S* grad_y, const S* kept, S* grad_x,
                         S* grad_params);

// Skinning ------------------------------------------------------------------------------------------------------------
// Linear blend skinning of points by sparse control nodes, as in SC-GS (Huang et al. 2024): every point x follows B of
// the S nodes, each of which rotates it about its own position p and shifts it,
//   offset = sum_b w_b (R_b a_b - a_b + d_b),  a_b = x - p_b,  w = softmax_b(-|a_b|^2 / (2 radius_b^2)).
// Any other values of the nodes are blended with the same weights. The weights count as constants in the gradients.

template <class S>
struct SkinNodes {
  const S* positions;  // (S, 3)
  const S* radii;      // (S,), positive
  const S* motion;     // (S, 7): shift d, quaternion wxyz of any length (zero = identity)
  const S* values;     // (S, width)
  int64_t count, width;
};

template <class S>
struct SkinPoints {
  const S* coords;          // (M, 3)
  const int64_t* followed;  // (M, B), each in [0, SkinNodes::count)
  int64_t count, nodes;     // M, B
};

template <class S>
struct Skinned {
  S* offset;   // (M, 3)
  S* blended;  // (M, width)
  S* weights;  // (M, B)
};

template <class S>
struct SkinGrads {
  S* points;  // (M, 3) of the offset alone, or null
  S* motion;  // (S, 7)
  S* values;  // (S, width)
};

// True if all indices are in [0, num_nodes).
bool follow_within(const int64_t* followed, int64_t size, int64_t num_nodes);

template <class S>
void skinning_forward(const SkinNodes<S>& nodes, const SkinPoints<S>& points, const Skinned<S>& out, int threads);

// Gradients of sum(offset * g.offset) + sum(blended * g.blended); g.weights holds the weights that the forward pass wrote.
template <class S>
void skinning_backward(const SkinNodes<S>& nodes, const SkinPoints<S>& points, const Skinned<const S>& g,
                       const SkinGrads<S>& grads, int threads);

// Control nodes -------------------------------------------------------------------------------------------------------
// Poses of nodes at a time, along uniform cubic B-splines, and the penalties of their motion.
inline constexpr int kHeads = 5;  // means, quaternions less the identity, log scales, opacity logits, colours

template <class S>
struct NodeSplines {
  const S* heads[kHeads];  // (S, P, head_size) control points, or null; the first is there
  int64_t count, points;   // S, P
  int64_t first;           // of the four control points that the time depends on
  S fractions[4];          // their weights
};
template <class S>
struct SplineGrads {
  S* heads[kHeads];  // (S, P, head_size), null where the splines are
};

// Writes motion (S, 7) as SkinNodes has it, and the values (S, width) of all heads but the first, one after the other.
template <class S>
void nodes_at(const NodeSplines<S>& splines, S* motion, S* values, int threads);
// Writes the gradients of sum(motion * by_motion) + sum(values * by_values), the latter unless null.
template <class S>
void nodes_at_backward(const NodeSplines<S>& splines, const S* by_motion, const S* by_values,
                       const SplineGrads<S>& grads, int threads);

template <class S>
struct NodeGraph {
  const S *positions, *radii;   // (S, 3), (S,) positive
  const int64_t* neighbours;    // (S, B), each in [0, S)
  const S *motion, *paths;      // (S, 7) at a time, (S, P, 3) control points of the shifts
  int64_t count, near, points;  // S, B, P
};
// Writes two penalties in squared radii, and their gradients: the mean square of the paths' second differences, by the paths;
// the mean of |d_j - d_i - (R_i - I) (p_j - p_i)|^2 over neighbours j of nodes i (Sorkine and Alexa 2007), by the motion.
template <class S>
void node_penalties(const NodeGraph<S>& graph, double* penalties, S* by_paths, S* by_motion, int threads);

// Skinning by joints --------------------------------------------------------------------------------------------------
// A body's Gaussians in a pose, by linear blend skinning (Loper et al. 2015): T = sum_j w_j A_j moves the mean and, exactly,
// the covariance of each (math/posing.hpp).

template <class S>
struct Posing {
  int64_t count, joints;                // N, J
  const S *means, *quats, *log_scales;  // (N, 3), (N, 4) wxyz of any length (zero = identity), (N, 3), at rest
  const S* weights;                     // (N, J)
  const S* transforms;                  // (J, 3, 4) posed_from_rest
};

// `kept` is for the backward pass: of each covariance V (3, 3), then the axes' lengths relative to the longest at rest.
template <class S>
struct Posed {
  S *means, *quats, *log_scales;  // (N, 3), (N, 4), (N, 3)
  S* blended;                     // (N, 3, 4) T
  S* kept;                        // (N, 12)
};

template <class S>
struct PosedGrads {
  const S *means, *quats, *log_scales;  // shapes of Posed
  const S* blended;                     // or null
};

template <class S>
struct PosingGrads {
  S *means, *quats, *log_scales;  // shapes of Posing
  S* weights;                     // or null
  S* transforms;
};

template <class S>
void pose_forward(const Posing<S>& in, const Posed<S>& out, int threads);

// `posed` is what the forward pass wrote; its means and log scales are not read.
template <class S>
void pose_backward(const Posing<S>& in, const Posed<const S>& posed, const PosedGrads<S>& g, const PosingGrads<S>& out,
                   int threads);

// Slicing of 4D Gaussians ---------------------------------------------------------------------------------------------
// Gaussians of space and time (Yang et al. 2024), conditioned on a time (math/slicing.hpp).

template <class S>
struct SpaceTimeGaussians {
  int64_t count;                 // M
  const S *means, *times;        // (M, 3), (M,)
  const S *quats, *right_quats;  // (M, 4) q_l and q_r of any length (zero = identity): the rotation is v -> q_l v q_r
  const S *log_scales, *log_spans;  // (M, 3), (M,) of the axes x, y, z and t
  const S* logit_opacities;         // (M,)
};

// `basis` is for the backward pass: the axes as orthonormal combinations of those of the 4D Gaussian.
template <class S>
struct Slice {
  S *means, *quats, *log_scales, *logit_opacities;  // (M, 3), (M, 4), (M, 3), (M,)
  S* basis;                                         // (M, 4, 3)
};

template <class S>
struct SliceGrads {
  const S *means, *quats, *log_scales, *logit_opacities;  // shapes of Slice
};

template <class S>
struct SpaceTimeGrads {
  S *means, *times, *quats, *right_quats, *log_scales, *log_spans, *logit_opacities;  // shapes of SpaceTimeGaussians
};

// Where exp(-z) of the weight in time is at most exp(-most_faded), the logit is -1e4, without gradient.
template <class S>
struct SliceTime {
  S time, most_faded;
};

template <class S>
void slice_forward(const SpaceTimeGaussians<S>& in, const SliceTime<S>& at, const Slice<S>& out, int threads);

// `slice` is what the forward pass wrote; its means and logits are not read.
template <class S>
void slice_backward(const SpaceTimeGaussians<S>& in, const SliceTime<S>& at, const Slice<const S>& slice,
                    const SliceGrads<S>& g, const SpaceTimeGrads<S>& out, int threads);

// What a slice has in common at all times.
template <class S>
struct Conditional {
  S *quats, *log_scales, *velocities, *log_deviations;  // (M, 4), (M, 3), (M, 3), (M,) of time
};

// Of `in`, only rotations and scales are read.
template <class S>
void condition(const SpaceTimeGaussians<S>& in, const Conditional<S>& out, int threads);

// Coefficients of harmonics that change over time, sh + sum_n cos(2 pi n elapsed) sh_time_n.
template <class S>
struct TimeHarmonics {
  int64_t count, width, waves;  // A, numbers per Gaussian 3 K, cosines
  const S* sh;                  // (A, width)
  const S* sh_time;             // (M, waves, width)
  const int64_t* rows;          // (A,) of sh_time, none twice; null: the first A
  const S* elapsed;             // (A,)
  const bool* seen;             // (A,); others keep sh
};

// Writes (A, width).
template <class S>
void time_harmonics(const TimeHarmonics<S>& in, S* out, int threads);

// Writes `by_sh_time` in the rows of A, zero where not seen, and `by_elapsed` (A,), from the gradient `g` (A, width).
template <class S>
void time_harmonics_backward(const TimeHarmonics<S>& in, const S* g, S* by_sh_time, S* by_elapsed, int threads);

// Offsets of a deformation field (dyngs/deform has the formulas in torch) -----------------------------------------------

// Of M rows; null: no change of that.
template <class S>
struct RowOffsets {
  int64_t count;
  const int64_t* rows;                                             // (M) which Gaussians; null: the first ones
  const S *means, *quats, *log_scales, *logit_opacities, *colors;  // (M, 3), (M, 4), (M, 3), (M,), (M, 3)
};

template <class S>
struct MovedGaussians {
  S *means, *quats, *log_scales, *logit_opacities, *sh;  // (N, ...)
  int64_t sh_stride;                                     // scalars per Gaussian
};

// Adds the offsets in place. Rotations are multiplied by identity + offset, not normalised. No row may occur twice.
template <class S>
void add_offsets(const RowOffsets<S>& offsets, const MovedGaussians<S>& gaussians, int threads);

// Gradients by moved Gaussians, (N, ...), null for what did not change; where those by the offsets (M, ...) go.
template <class S>
struct OffsetGrads {
  const S *means, *log_scales, *logit_opacities, *sh;
  int64_t sh_stride;
  S *by_means, *by_quats, *by_log_scales, *by_logit_opacities, *by_colors;
  S* quats;  // (N, 4): in, by the quaternions after; out, before
};

// `quats` (N, 4): the quaternions before. Of `offsets` the rows and quaternions matter.
template <class S>
void add_offsets_backward(const RowOffsets<S>& offsets, const S* quats, const OffsetGrads<S>& grads, int threads);

// Inputs of the network of compact colour (dyngs/ops/shading.py has the formulas in torch) ------------------------------

template <class S>
struct Shading {
  int64_t rows;                         // M
  const int64_t* picked;                // (M) which Gaussians
  const S *means, *quats, *log_scales;  // (N, 3), (N, 4), (N, 3)
  const S* base;                        // (M, 3) colours
  const S* eye;                         // (3) camera centre
  const S* box;                         // (2, 3) centre and half sides
  const S* places;                      // (N, 3) means at rest, or null: the means
  const S* turn;                        // (3, 3) rotation from rest to the world, or null
  bool normals, timed;
  S time;  // in [-1, 1]
  int threads;

  int64_t width() const { return 9 + 4 * normals + timed; }
};

// Writes (M, width): place in the box, direction, with normals the cosine to the normal and the reflected direction, base
// colour, time if there is one.
template <class S>
void shading_inputs(const Shading<S>& in, S* out);

// Training ------------------------------------------------------------------------------------------------------------

struct LossInput {
  const float* rendered;  // (H, W, 3)
  const float* target;    // (H, W, 3)
  const float* mask;      // (H, W) weights, or null for all ones
  int64_t height;
  int64_t width;
  float ssim_weight;
};

// Returns (1 - ssim_weight) * mean|x - y| + ssim_weight * (1 - mean SSIM(x, y)), both means weighted by the mask.
// Writes d loss / d rendered into `gradient` (H, W, 3) unless that is null. A mask without any weight gives 0 and a zero
// gradient.
double l1_ssim_loss(const LossInput& input, float* gradient, int threads);

// Arrays of num_rows x row_size floats, updated in place except for the gradient.
struct AdamState {
  float* param;
  const float* grad;
  float* exp_avg;
  float* exp_avg_sq;
  int64_t num_rows;
  int64_t row_size;
};

struct AdamRates {
  const float* column_rates;  // (row_size,) learning rates
  const bool* rows;           // (num_rows,) rows to update, or null for all
  double beta1;
  double beta2;
  double eps;
  int64_t step;  // 1 for the first update
};

// One step. Updates the rows asked for whose gradient is below 2^63 throughout, and leaves value and moments of all others
// as they are. Returns the number of rows that were asked for but had NaN, infinity or a larger gradient.
int64_t adam_step(const AdamState& state, const AdamRates& rates, int threads);

// Sets seen[r] where row r of grads (num_rows, row_size) has an element other than zero; NaN counts as such.
void seen_rows(const float* grads, int64_t num_rows, int64_t row_size, bool* seen, int threads);

// How many of n elements are NaN or infinite.
template <class S>
int64_t count_nonfinite(const S* x, int64_t n, int threads);

}  // namespace dyngs
