// The ops of core/api.hpp, core/fields.hpp and core/triangles.hpp on a CUDA GPU, in float32: the same structs with pointers to the GPU's memory
// (`threads` is not read), the same results up to rounding, and the same bytes whenever a call is repeated. Work is queued on
// `stream`; nothing is allocated and nothing waits, but for the one number that bin_entries reads back. A function with a
// `workspace` takes memory that the caller allocated, of at least as many bytes as its neighbour `..._workspace` says; its
// contents are of no use afterwards. Errors of a launch are thrown as std::runtime_error.
#pragma once

#include "core/api.hpp"
#include "core/fields.hpp"
#include "core/triangles.hpp"

namespace dyngs::cuda {

using Stream = void*;  // a cudaStream_t

// Memory of the GPU that is lent for one call.
struct Lent {
  void* memory;
  int64_t bytes;
};

// Projection ----------------------------------------------------------------------------------------------------------

void project_forward(const GaussianViews<float>& in, const ProjectOptions<float>& options, const Projected<float>& out,
                     Stream stream);
int64_t project_backward_workspace(int64_t num_gaussians, int64_t num_views);
void project_backward(const GaussianViews<float>& in, const ProjectOptions<float>& options, const int32_t* radii,
                      const ProjectedGrads<float>& grads, const GaussianGrads<float>& out, const Lent& workspace,
                      Stream stream);

// Spherical harmonics -------------------------------------------------------------------------------------------------

void harmonics_forward(const Harmonics<float>& in, float* colors, Stream stream);
int64_t harmonics_backward_workspace(int64_t num_gaussians, int64_t num_views);
void harmonics_backward(const Harmonics<float>& in, const float* colors, const float* grad_colors, float* grad_means,
                        float* grad_sh, float* grad_centers, const Lent& workspace, Stream stream);

// Rasterization -------------------------------------------------------------------------------------------------------

// Binning takes two calls, since the caller allocates the lists between them. bin_count sorts by depth, counts, and
// returns the number of entries E; it throws std::length_error with the numbers if that is more than `max_entries`.
// bin_emit writes the lists; its `entries` are those of core/api.hpp with room for E, and `counted` the workspace as
// bin_count left it.
struct EntryArrays {
  int64_t* tile_offsets;  // (V * tiles + 1)
  int32_t* slot_ranges;   // (V * N, 2)
  int32_t* gaussians;     // (E,)
  int32_t* slots;         // (E,)
};
int64_t bin_count_workspace(int64_t num_splats);
int64_t bin_count(const Splats<float>& splats, int64_t max_entries, const Lent& workspace, Stream stream);
int64_t bin_emit_workspace(int64_t num_entries);
void bin_emit(const Splats<float>& splats, int64_t num_entries, const Lent& counted, const EntryArrays& out,
              const Lent& workspace, Stream stream);

int64_t rasterize_forward_workspace(int64_t num_entries, Tally tallied);
void rasterize_forward(const Splats<float>& splats, const Entries& entries, const Image<float>& image,
                       const Lent& workspace, Stream stream);
int64_t rasterize_backward_workspace(int64_t num_entries, int channels, bool absolute);
void rasterize_backward(const Splats<float>& splats, const Entries& entries, const ImageGrads<float>& image,
                        const SplatGrads<float>& out, const Lent& workspace, Stream stream);

// Factored space-time grids -------------------------------------------------------------------------------------------

// `levels` of HexPlane and `grads` are arrays of the host with pointers to the GPU's memory. No order of the points is needed.
int64_t hexplane_forward_workspace(const HexPlane<float>& planes);
void hexplane_forward(const HexPlane<float>& planes, const PlanePoints<float>& points, float* features,
                      const Lent& workspace, Stream stream);
int64_t hexplane_backward_workspace(const HexPlane<float>& planes, int64_t num_points);
void hexplane_backward(const HexPlane<float>& planes, const PlanePoints<float>& points, const float* g_features,
                       std::span<const PlaneGrads<float>> grads, float* g_coords, const Lent& workspace, Stream stream);

int64_t plane_penalty_workspace(const HexPlane<float>& planes);
// Writes the penalty to `penalty` (one double on the GPU).
void plane_penalty(const HexPlane<float>& planes, const PenaltyWeights& weights,
                   std::span<const PlaneGrads<float>> grads, double* penalty, const Lent& workspace, Stream stream);

// Perceptron ----------------------------------------------------------------------------------------------------------

inline constexpr int kPerceptronLayers = 16, kPerceptronWidth = 256;  // at most, x and outputs included
inline constexpr int64_t kPerceptronBytes = 128 << 20;

bool perceptron_fits(const Perceptron<float>& net);
int64_t perceptron_forward_workspace(const Perceptron<float>& net);
void perceptron_forward(const Perceptron<float>& net, int64_t rows, const float* x, float* y, const Lent& workspace,
                        Stream stream);
// The activations are computed again, of as many rows at a time as fit `bytes`.
int64_t perceptron_backward_workspace(const Perceptron<float>& net, int64_t rows, int64_t bytes = kPerceptronBytes);
void perceptron_backward(const Perceptron<float>& net, int64_t rows, const float* x, const float* grad_y, float* grad_x,
                         float* grad_params, const Lent& workspace, Stream stream, int64_t bytes = kPerceptronBytes);

// Moving Gaussians ----------------------------------------------------------------------------------------------------

int64_t skinning_forward_workspace(int64_t num_nodes);
void skinning_forward(const SkinNodes<float>& nodes, const SkinPoints<float>& points, const Skinned<float>& out,
                      const Lent& workspace, Stream stream);
int64_t skinning_backward_workspace(int64_t num_nodes, int64_t num_points, int64_t nodes_per_point);
void skinning_backward(const SkinNodes<float>& nodes, const SkinPoints<float>& points, const Skinned<const float>& g,
                       const SkinGrads<float>& grads, const Lent& workspace, Stream stream);

void pose_forward(const Posing<float>& in, const Posed<float>& out, Stream stream);
int64_t pose_backward_workspace(int64_t count, int64_t joints);
void pose_backward(const Posing<float>& in, const Posed<const float>& posed, const PosedGrads<float>& g,
                   const PosingGrads<float>& out, const Lent& workspace, Stream stream);

void slice_forward(const SpaceTimeGaussians<float>& in, const SliceTime<float>& at, const Slice<float>& out,
                   Stream stream);
void slice_backward(const SpaceTimeGaussians<float>& in, const SliceTime<float>& at, const Slice<const float>& slice,
                    const SliceGrads<float>& g, const SpaceTimeGrads<float>& out, Stream stream);
void condition(const SpaceTimeGaussians<float>& in, const Conditional<float>& out, Stream stream);
void time_harmonics(const TimeHarmonics<float>& in, float* out, Stream stream);
void time_harmonics_backward(const TimeHarmonics<float>& in, const float* g, float* by_sh_time, float* by_elapsed,
                             Stream stream);

void nodes_at(const NodeSplines<float>& splines, float* motion, float* values, Stream stream);
void nodes_at_backward(const NodeSplines<float>& splines, const float* by_motion, const float* by_values,
                       const SplineGrads<float>& grads, Stream stream);
int64_t node_penalties_workspace(const NodeGraph<float>& graph);
// `penalties`: two doubles on the GPU.
void node_penalties(const NodeGraph<float>& graph, double* penalties, float* by_paths, float* by_motion,
                    const Lent& workspace, Stream stream);

void add_offsets(const RowOffsets<float>& offsets, const MovedGaussians<float>& gaussians, Stream stream);
void add_offsets_backward(const RowOffsets<float>& offsets, const float* quats, const OffsetGrads<float>& grads,
                          Stream stream);
void shading_inputs(const Shading<float>& in, float* out, Stream stream);

// Radiance fields -----------------------------------------------------------------------------------------------------

inline constexpr int64_t kHashSamples = 1 << 18;

// `levels` are an array of the host.
void hash_grid_forward(const HashGrid<float>& grid, const float* table, float* features, Stream stream);
// Of `at_once` samples at a time.
int64_t hash_grid_backward_workspace(const HashGrid<float>& grid, int64_t at_once = kHashSamples);
void hash_grid_backward(const HashGrid<float>& grid, const float* g_features, float* g_table, const Lent& workspace,
                        Stream stream, int64_t at_once = kHashSamples);

void march_count(const March<float>& march, int64_t* counts, Stream stream);
void march_samples(const March<float>& march, const int64_t* offsets, const Samples<float>& out, Stream stream);
void composite_forward(const RaySamples<float>& in, const Composited<float>& out, Stream stream);
void composite_backward(const RaySamples<float>& in, const Composited<const float>& grads, float* g_densities,
                        float* g_colours, Stream stream);
void reached_samples(const RaySamples<float>& in, bool* reached, int64_t* counts, Stream stream);

// Curved triangles ----------------------------------------------------------------------------------------------------

void patch_values_forward(const PatchPlaces& places, const float* uv, const float* values, float* out, Stream stream);
int64_t patch_values_backward_workspace(const PatchPlaces& places);
void patch_values_backward(const PatchPlaces& places, const float* uv, const float* g_out, float* g_values,
                           const Lent& workspace, Stream stream);
int64_t visible_patches_workspace(const PatchViews<float>& in);
void visible_patches(const PatchViews<float>& in, const VisiblePatches<float>& out, const Lent& workspace,
                     Stream stream);
void patch_ends(const PatchSteps<float>& in, const PatchEnds<float>& out, Stream stream);
void blend_patches_forward(const PatchImage<float>& in, const BlendedPatches<float>& out, Stream stream);
void blend_patches_backward(const PatchImage<float>& in, const BlendedPatches<const float>& grads,
                            const PatchGrads<float>& out, Stream stream);

// Training ------------------------------------------------------------------------------------------------------------

int64_t l1_ssim_loss_workspace(int64_t height, int64_t width);
// Writes the loss to `loss` (one double on the GPU) and, unless null, its gradient (H, W, 3).
void l1_ssim_loss(const LossInput& input, double* loss, float* gradient, const Lent& workspace, Stream stream);

// Adds to *skipped the rows that were asked for but had NaN, infinity or a gradient of 2^63 or more.
void adam_step(const AdamState& state, const AdamRates& rates, int32_t* skipped, Stream stream);
void seen_rows(const float* grads, int64_t num_rows, int64_t row_size, bool* seen, Stream stream);
// Adds to *count how many of n elements are NaN or infinite.
void count_nonfinite(const float* x, int64_t n, int32_t* count, Stream stream);

}  // namespace dyngs::cuda
