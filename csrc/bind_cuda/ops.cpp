// The ops of core/api.hpp, core/fields.hpp and core/triangles.hpp that the bindings call, on a GPU: those of cuda/api.hpp, queued on the
// stream set by use_queue, with memory allocated by torch. They compute in float32; dyngs/ops/native.py rejects float64.
#include "core/api.hpp"

#include "bind/results.hpp"
#include "bind_cuda/queue.hpp"
#include "cuda/api.hpp"

namespace dyngs {
namespace {

using cuda::Borrowed;
using cuda::current_stream;

}  // namespace

// Projection and harmonics --------------------------------------------------------------------------------------------

template <>
void project_forward(const GaussianViews<float>& in, const ProjectOptions<float>& options,
                     const Projected<float>& out) {
  cuda::project_forward(in, options, out, current_stream());
}

template <>
void project_backward(const GaussianViews<float>& in, const ProjectOptions<float>& options, const int32_t* radii,
                      const ProjectedGrads<float>& grads, const GaussianGrads<float>& out) {
  const Borrowed memory(cuda::project_backward_workspace(in.num_gaussians, in.num_views));
  cuda::project_backward(in, options, radii, grads, out, memory.lent(), current_stream());
}

template <>
void harmonics_forward(const Harmonics<float>& in, float* colors) {
  cuda::harmonics_forward(in, colors, current_stream());
}

template <>
void harmonics_backward(const Harmonics<float>& in, const float* colors, const float* grad_colors, float* grad_means,
                        float* grad_sh, float* grad_centers) {
  const Borrowed memory(cuda::harmonics_backward_workspace(in.num_gaussians, in.num_views));
  cuda::harmonics_backward(in, colors, grad_colors, grad_means, grad_sh, grad_centers, memory.lent(), current_stream());
}

// Rasterization -------------------------------------------------------------------------------------------------------

template <>
nb::tuple binned(const Splats<float>& splats, int64_t max_entries) {
  const int64_t rows = splats.num_views * splats.num_gaussians;
  const Borrowed counted(cuda::bin_count_workspace(rows));
  int64_t count = 0;
  {
    const nb::gil_scoped_release release;
    count = cuda::bin_count(splats, max_entries, counted.lent(), current_stream());
  }
  const Borrowed tile_offsets((splats.tiles() + 1) * int64_t{sizeof(int64_t)});
  const Borrowed slot_ranges(2 * rows * int64_t{sizeof(int32_t)});
  const Borrowed gaussians(count * int64_t{sizeof(int32_t)}), slots(count * int64_t{sizeof(int32_t)});
  const Borrowed memory(cuda::bin_emit_workspace(count));
  const cuda::EntryArrays out{tile_offsets.array<int64_t>(), slot_ranges.array<int32_t>(), gaussians.array<int32_t>(),
                              slots.array<int32_t>()};
  {
    const nb::gil_scoped_release release;
    cuda::bin_emit(splats, count, counted.lent(), out, memory.lent(), current_stream());
  }
  return nb::make_tuple(tile_offsets.tensor(), slot_ranges.tensor(), gaussians.tensor(), slots.tensor());
}

template <>
void rasterize_forward(const Splats<float>& splats, const Entries& entries, const Image<float>& image) {
  const Borrowed memory(cuda::rasterize_forward_workspace(entries.count, image.tallied));
  cuda::rasterize_forward(splats, entries, image, memory.lent(), current_stream());
}

template <>
void rasterize_backward(const Splats<float>& splats, const Entries& entries, const ImageGrads<float>& image,
                        const SplatGrads<float>& out) {
  const bool absolute = out.probe != nullptr && out.absolute;
  const Borrowed memory(cuda::rasterize_backward_workspace(entries.count, splats.channels, absolute));
  cuda::rasterize_backward(splats, entries, image, out, memory.lent(), current_stream());
}

// Factored space-time grids -------------------------------------------------------------------------------------------

// No order of the points is needed, so that none is written.
template <>
void hexplane_forward(const HexPlane<float>& planes, const PlanePoints<float>& points, float* features, int32_t*, int) {
  const Borrowed memory(cuda::hexplane_forward_workspace(planes));
  cuda::hexplane_forward(planes, points, features, memory.lent(), current_stream());
}

template <>
void hexplane_backward(const HexPlane<float>& planes, const PlanePoints<float>& points, const int32_t*,
                       const float* g_features, std::span<const PlaneGrads<float>> grads, float* g_coords, int) {
  const Borrowed memory(cuda::hexplane_backward_workspace(planes, points.count));
  cuda::hexplane_backward(planes, points, g_features, grads, g_coords, memory.lent(), current_stream());
}

template <>
void write_plane_penalty(const HexPlane<float>& planes, const PenaltyWeights& weights,
                         std::span<const PlaneGrads<float>> grads, double* penalty, int) {
  const Borrowed memory(cuda::plane_penalty_workspace(planes));
  cuda::plane_penalty(planes, weights, grads, penalty, memory.lent(), current_stream());
}

// Perceptron ----------------------------------------------------------------------------------------------------------

// The backward pass computes the activations again.
template <>
int64_t Perceptron<float>::kept_per_row() const {
  return 0;
}

template <>
void perceptron_forward(const Perceptron<float>& net, int64_t rows, const float* x, float* y, float*) {
  const Borrowed memory(cuda::perceptron_forward_workspace(net));
  cuda::perceptron_forward(net, rows, x, y, memory.lent(), current_stream());
}

template <>
void perceptron_backward(const Perceptron<float>& net, int64_t rows, const float* x, const float* grad_y, const float*,
                         float* grad_x, float* grad_params) {
  const Borrowed memory(cuda::perceptron_backward_workspace(net, rows));
  cuda::perceptron_backward(net, rows, x, grad_y, grad_x, grad_params, memory.lent(), current_stream());
}

// Moving Gaussians ----------------------------------------------------------------------------------------------------

bool follow_within(const int64_t*, int64_t, int64_t) { return true; }  // not readable, see bind/arrays.hpp

template <>
void skinning_forward(const SkinNodes<float>& nodes, const SkinPoints<float>& points, const Skinned<float>& out, int) {
  const Borrowed memory(cuda::skinning_forward_workspace(nodes.count));
  cuda::skinning_forward(nodes, points, out, memory.lent(), current_stream());
}

template <>
void skinning_backward(const SkinNodes<float>& nodes, const SkinPoints<float>& points, const Skinned<const float>& g,
                       const SkinGrads<float>& grads, int) {
  const Borrowed memory(cuda::skinning_backward_workspace(nodes.count, points.count, points.nodes));
  cuda::skinning_backward(nodes, points, g, grads, memory.lent(), current_stream());
}

template <>
void pose_forward(const Posing<float>& in, const Posed<float>& out, int) {
  cuda::pose_forward(in, out, current_stream());
}

template <>
void pose_backward(const Posing<float>& in, const Posed<const float>& posed, const PosedGrads<float>& g,
                   const PosingGrads<float>& out, int) {
  const Borrowed memory(cuda::pose_backward_workspace(in.count, in.joints));
  cuda::pose_backward(in, posed, g, out, memory.lent(), current_stream());
}

template <>
void slice_forward(const SpaceTimeGaussians<float>& in, const SliceTime<float>& at, const Slice<float>& out, int) {
  cuda::slice_forward(in, at, out, current_stream());
}

template <>
void slice_backward(const SpaceTimeGaussians<float>& in, const SliceTime<float>& at, const Slice<const float>& slice,
                    const SliceGrads<float>& g, const SpaceTimeGrads<float>& out, int) {
  cuda::slice_backward(in, at, slice, g, out, current_stream());
}

template <>
void condition(const SpaceTimeGaussians<float>& in, const Conditional<float>& out, int) {
  cuda::condition(in, out, current_stream());
}

template <>
void time_harmonics(const TimeHarmonics<float>& in, float* out, int) {
  cuda::time_harmonics(in, out, current_stream());
}

template <>
void time_harmonics_backward(const TimeHarmonics<float>& in, const float* g, float* by_sh_time, float* by_elapsed,
                             int) {
  cuda::time_harmonics_backward(in, g, by_sh_time, by_elapsed, current_stream());
}

template <>
void add_offsets(const RowOffsets<float>& offsets, const MovedGaussians<float>& gaussians, int) {
  cuda::add_offsets(offsets, gaussians, current_stream());
}

template <>
void add_offsets_backward(const RowOffsets<float>& offsets, const float* quats, const OffsetGrads<float>& grads, int) {
  cuda::add_offsets_backward(offsets, quats, grads, current_stream());
}

template <>
void nodes_at(const NodeSplines<float>& splines, float* motion, float* values, int) {
  cuda::nodes_at(splines, motion, values, current_stream());
}

template <>
void nodes_at_backward(const NodeSplines<float>& splines, const float* by_motion, const float* by_values,
                       const SplineGrads<float>& grads, int) {
  cuda::nodes_at_backward(splines, by_motion, by_values, grads, current_stream());
}

template <>
void node_penalties(const NodeGraph<float>& graph, double* penalties, float* by_paths, float* by_motion, int) {
  const Borrowed memory(cuda::node_penalties_workspace(graph));
  cuda::node_penalties(graph, penalties, by_paths, by_motion, memory.lent(), current_stream());
}

template <>
void shading_inputs(const Shading<float>& in, float* out) {
  cuda::shading_inputs(in, out, current_stream());
}

// Radiance fields -----------------------------------------------------------------------------------------------------

template <>
void hash_grid_forward(const HashGrid<float>& grid, const float* table, float* features) {
  cuda::hash_grid_forward(grid, table, features, current_stream());
}

template <>
void hash_grid_backward(const HashGrid<float>& grid, const float* g_features, float* g_table) {
  const Borrowed memory(cuda::hash_grid_backward_workspace(grid));
  cuda::hash_grid_backward(grid, g_features, g_table, memory.lent(), current_stream());
}

template <>
void march_count(const March<float>& march, int64_t* counts) {
  cuda::march_count(march, counts, current_stream());
}

template <>
void march_samples(const March<float>& march, const int64_t* offsets, const Samples<float>& out) {
  cuda::march_samples(march, offsets, out, current_stream());
}

template <>
void composite_forward(const RaySamples<float>& in, const Composited<float>& out) {
  cuda::composite_forward(in, out, current_stream());
}

template <>
void composite_backward(const RaySamples<float>& in, const Composited<const float>& grads, float* g_densities,
                        float* g_colours) {
  cuda::composite_backward(in, grads, g_densities, g_colours, current_stream());
}

template <>
void reached_samples(const RaySamples<float>& in, bool* reached, int64_t* counts) {
  cuda::reached_samples(in, reached, counts, current_stream());
}

// Curved triangles ----------------------------------------------------------------------------------------------------

template <>
void patch_values_forward(const PatchPlaces& places, const float* uv, const float* values, float* out) {
  cuda::patch_values_forward(places, uv, values, out, current_stream());
}

template <>
void patch_values_backward(const PatchPlaces& places, const float* uv, const float* g_out, float* g_values) {
  const Borrowed memory(cuda::patch_values_backward_workspace(places));
  cuda::patch_values_backward(places, uv, g_out, g_values, memory.lent(), current_stream());
}

template <>
void visible_patches(const PatchViews<float>& in, const VisiblePatches<float>& out) {
  const Borrowed memory(cuda::visible_patches_workspace(in));
  cuda::visible_patches(in, out, memory.lent(), current_stream());
}

template <>
void patch_ends(const PatchSteps<float>& in, const PatchEnds<float>& out) {
  cuda::patch_ends(in, out, current_stream());
}

template <>
void blend_patches_forward(const PatchImage<float>& in, const BlendedPatches<float>& out) {
  cuda::blend_patches_forward(in, out, current_stream());
}

template <>
void blend_patches_backward(const PatchImage<float>& in, const BlendedPatches<const float>& grads,
                            const PatchGrads<float>& out) {
  cuda::blend_patches_backward(in, grads, out, current_stream());
}

// Training ------------------------------------------------------------------------------------------------------------

void write_l1_ssim(const LossInput& input, double* loss, float* gradient, int) {
  const Borrowed memory(cuda::l1_ssim_loss_workspace(input.height, input.width));
  cuda::l1_ssim_loss(input, loss, gradient, memory.lent(), current_stream());
}

void write_adam_step(const AdamState& state, const AdamRates& rates, int32_t* skipped, int) {
  cuda::adam_step(state, rates, skipped, current_stream());
}

void seen_rows(const float* grads, int64_t num_rows, int64_t row_size, bool* seen, int) {
  cuda::seen_rows(grads, num_rows, row_size, seen, current_stream());
}

template <>
void write_count_nonfinite(const float* x, int64_t n, int32_t* count, int) {
  cuda::count_nonfinite(x, n, count, current_stream());
}

}  // namespace dyngs
