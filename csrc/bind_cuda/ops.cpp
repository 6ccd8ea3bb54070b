// The ops of core/api.hpp that the bindings call, on a card: those of cuda/api.hpp, queued where use_queue says, with memory
// that torch lends. They compute in float32; float64 is refused.
#include "core/api.hpp"

#include <stdexcept>
#include <type_traits>

#include "bind/results.hpp"
#include "bind_cuda/queue.hpp"
#include "cuda/api.hpp"

namespace nb = nanobind;

namespace dyngs {
namespace {

using cuda::Borrowed;
using cuda::current_stream;

template <class S>
void require_float() {
  if constexpr (!std::is_same_v<S, float>) throw std::invalid_argument("float64 is not there on a GPU; use float32");
}

}  // namespace

// Projection and harmonics --------------------------------------------------------------------------------------------

template <class S>
void project_forward(const GaussianViews<S>& in, const ProjectOptions<S>& options, const Projected<S>& out) {
  require_float<S>();
  if constexpr (std::is_same_v<S, float>) cuda::project_forward(in, options, out, current_stream());
}

template <class S>
void project_backward(const GaussianViews<S>& in, const ProjectOptions<S>& options, const int32_t* radii,
                      const ProjectedGrads<S>& grads, const GaussianGrads<S>& out) {
  require_float<S>();
  if constexpr (std::is_same_v<S, float>) {
    const Borrowed memory(cuda::project_backward_workspace(in.num_gaussians, in.num_views));
    cuda::project_backward(in, options, radii, grads, out, memory.lent(), current_stream());
  }
}

template <class S>
void harmonics_forward(const Harmonics<S>& in, S* colors) {
  require_float<S>();
  if constexpr (std::is_same_v<S, float>) cuda::harmonics_forward(in, colors, current_stream());
}

template <class S>
void harmonics_backward(const Harmonics<S>& in, const S* colors, const S* grad_colors, S* grad_means, S* grad_sh,
                        S* grad_centers) {
  require_float<S>();
  if constexpr (std::is_same_v<S, float>) {
    const Borrowed memory(cuda::harmonics_backward_workspace(in.num_gaussians, in.num_views));
    cuda::harmonics_backward(in, colors, grad_colors, grad_means, grad_sh, grad_centers, memory.lent(),
                             current_stream());
  }
}

// Rasterization -------------------------------------------------------------------------------------------------------

template <class S>
nb::tuple binned(const Splats<S>& splats, int64_t max_entries) {
  require_float<S>();
  if constexpr (std::is_same_v<S, float>) {
    const int64_t rows = splats.num_views * splats.num_gaussians;
    const Borrowed counted(cuda::bin_count_workspace(rows));
    int64_t count = 0;
    {
      const nb::gil_scoped_release release;
      count = cuda::bin_count(splats, max_entries, counted.lent(), current_stream());
    }
    const int64_t tiles = ((splats.width + kTile - 1) / kTile) * int64_t{(splats.height + kTile - 1) / kTile};
    const Borrowed tile_offsets((splats.num_views * tiles + 1) * int64_t{sizeof(int64_t)});
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
  return nb::tuple();
}

template <class S>
void rasterize_forward(const Splats<S>& splats, const Entries& entries, const Image<S>& image) {
  require_float<S>();
  if constexpr (std::is_same_v<S, float>) {
    const Borrowed memory(cuda::rasterize_forward_workspace(entries.count, image.tallied));
    cuda::rasterize_forward(splats, entries, image, memory.lent(), current_stream());
  }
}

template <class S>
void rasterize_backward(const Splats<S>& splats, const Entries& entries, const ImageGrads<S>& image,
                        const SplatGrads<S>& out) {
  require_float<S>();
  if constexpr (std::is_same_v<S, float>) {
    const bool absolute = out.probe != nullptr && out.absolute;
    const Borrowed memory(cuda::rasterize_backward_workspace(entries.count, splats.channels, absolute));
    cuda::rasterize_backward(splats, entries, image, out, memory.lent(), current_stream());
  }
}

// Factored space-time grids -------------------------------------------------------------------------------------------

// No order of the points is needed, so that none is written.
template <class S>
void hexplane_forward(const HexPlane<S>& planes, const PlanePoints<S>& points, S* features, int32_t*, int) {
  require_float<S>();
  if constexpr (std::is_same_v<S, float>) {
    const Borrowed memory(cuda::hexplane_forward_workspace(planes));
    cuda::hexplane_forward(planes, points, features, memory.lent(), current_stream());
  }
}

template <class S>
void hexplane_backward(const HexPlane<S>& planes, const PlanePoints<S>& points, const int32_t*, const S* g_features,
                       std::span<const PlaneGrads<S>> grads, S* g_coords, int) {
  require_float<S>();
  if constexpr (std::is_same_v<S, float>) {
    const Borrowed memory(cuda::hexplane_backward_workspace(planes, points.count));
    cuda::hexplane_backward(planes, points, g_features, grads, g_coords, memory.lent(), current_stream());
  }
}

template <class S>
void write_plane_penalty(const HexPlane<S>& planes, const PenaltyWeights& weights, std::span<const PlaneGrads<S>> grads,
                         double* penalty, int) {
  require_float<S>();
  if constexpr (std::is_same_v<S, float>) {
    const Borrowed memory(cuda::plane_penalty_workspace(planes));
    cuda::plane_penalty(planes, weights, grads, penalty, memory.lent(), current_stream());
  }
}

// Perceptron ----------------------------------------------------------------------------------------------------------

// The backward pass computes the activations again.
template <class S>
int64_t Perceptron<S>::kept_per_row() const {
  return 0;
}

template <class S>
void perceptron_forward(const Perceptron<S>& net, int64_t rows, const S* x, S* y, S*) {
  require_float<S>();
  if constexpr (std::is_same_v<S, float>) {
    const Borrowed memory(cuda::perceptron_forward_workspace(net));
    cuda::perceptron_forward(net, rows, x, y, memory.lent(), current_stream());
  }
}

template <class S>
void perceptron_backward(const Perceptron<S>& net, int64_t rows, const S* x, const S* grad_y, const S*, S* grad_x,
                         S* grad_params) {
  require_float<S>();
  if constexpr (std::is_same_v<S, float>) {
    const Borrowed memory(cuda::perceptron_backward_workspace(net, rows));
    cuda::perceptron_backward(net, rows, x, grad_y, grad_x, grad_params, memory.lent(), current_stream());
  }
}

// Moving Gaussians ----------------------------------------------------------------------------------------------------

bool follow_within(const int64_t*, int64_t, int64_t) { return true; }  // not readable, see bind/arrays.hpp

template <class S>
void skinning_forward(const SkinNodes<S>& nodes, const SkinPoints<S>& points, const Skinned<S>& out, int) {
  require_float<S>();
  if constexpr (std::is_same_v<S, float>) {
    const Borrowed memory(cuda::skinning_forward_workspace(nodes.count));
    cuda::skinning_forward(nodes, points, out, memory.lent(), current_stream());
  }
}

template <class S>
void skinning_backward(const SkinNodes<S>& nodes, const SkinPoints<S>& points, const Skinned<const S>& g,
                       const SkinGrads<S>& grads, int) {
  require_float<S>();
  if constexpr (std::is_same_v<S, float>) {
    const Borrowed memory(cuda::skinning_backward_workspace(nodes.count, points.count, points.nodes));
    cuda::skinning_backward(nodes, points, g, grads, memory.lent(), current_stream());
  }
}

template <class S>
void pose_forward(const Posing<S>& in, const Posed<S>& out, int) {
  require_float<S>();
  if constexpr (std::is_same_v<S, float>) cuda::pose_forward(in, out, current_stream());
}

template <class S>
void pose_backward(const Posing<S>& in, const Posed<const S>& posed, const PosedGrads<S>& g, const PosingGrads<S>& out,
                   int) {
  require_float<S>();
  if constexpr (std::is_same_v<S, float>) {
    const Borrowed memory(cuda::pose_backward_workspace(in.count, in.joints));
    cuda::pose_backward(in, posed, g, out, memory.lent(), current_stream());
  }
}

template <class S>
void add_offsets(const RowOffsets<S>& offsets, const MovedGaussians<S>& gaussians, int) {
  require_float<S>();
  if constexpr (std::is_same_v<S, float>) cuda::add_offsets(offsets, gaussians, current_stream());
}

template <class S>
void shading_inputs(const Shading<S>& in, S* out) {
  require_float<S>();
  if constexpr (std::is_same_v<S, float>) cuda::shading_inputs(in, out, current_stream());
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

template <class S>
void write_count_nonfinite(const S* x, int64_t n, int32_t* count, int) {
  require_float<S>();
  if constexpr (std::is_same_v<S, float>) cuda::count_nonfinite(x, n, count, current_stream());
}

// Of the formulas above, what the bindings call.
#define DYNGS_INSTANTIATE(S)                                                                                        \
  template void project_forward(const GaussianViews<S>&, const ProjectOptions<S>&, const Projected<S>&);            \
  template void project_backward(const GaussianViews<S>&, const ProjectOptions<S>&, const int32_t*,                 \
                                 const ProjectedGrads<S>&, const GaussianGrads<S>&);                                \
  template void harmonics_forward(const Harmonics<S>&, S*);                                                         \
  template void harmonics_backward(const Harmonics<S>&, const S*, const S*, S*, S*, S*);                            \
  template nb::tuple binned(const Splats<S>&, int64_t);                                                             \
  template void rasterize_forward(const Splats<S>&, const Entries&, const Image<S>&);                               \
  template void rasterize_backward(const Splats<S>&, const Entries&, const ImageGrads<S>&, const SplatGrads<S>&);   \
  template void hexplane_forward(const HexPlane<S>&, const PlanePoints<S>&, S*, int32_t*, int);                     \
  template void hexplane_backward(const HexPlane<S>&, const PlanePoints<S>&, const int32_t*, const S*,              \
                                  std::span<const PlaneGrads<S>>, S*, int);                                         \
  template void write_plane_penalty(const HexPlane<S>&, const PenaltyWeights&, std::span<const PlaneGrads<S>>,      \
                                    double*, int);                                                                  \
  template struct Perceptron<S>;                                                                                    \
  template void perceptron_forward(const Perceptron<S>&, int64_t, const S*, S*, S*);                                \
  template void perceptron_backward(const Perceptron<S>&, int64_t, const S*, const S*, const S*, S*, S*);           \
  template void skinning_forward(const SkinNodes<S>&, const SkinPoints<S>&, const Skinned<S>&, int);                \
  template void skinning_backward(const SkinNodes<S>&, const SkinPoints<S>&, const Skinned<const S>&,               \
                                  const SkinGrads<S>&, int);                                                        \
  template void pose_forward(const Posing<S>&, const Posed<S>&, int);                                               \
  template void pose_backward(const Posing<S>&, const Posed<const S>&, const PosedGrads<S>&, const PosingGrads<S>&, \
                              int);                                                                                 \
  template void add_offsets(const RowOffsets<S>&, const MovedGaussians<S>&, int);                                   \
  template void shading_inputs(const Shading<S>&, S*);                                                              \
  template void write_count_nonfinite(const S*, int64_t, int32_t*, int)
DYNGS_INSTANTIATE(float);
DYNGS_INSTANTIATE(double);
#undef DYNGS_INSTANTIATE

}  // namespace dyngs
