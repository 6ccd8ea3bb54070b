// The CPU kernels, compiled once per instruction set (the whole module is; see CMakeLists.txt).
#pragma once

#include "core/api.hpp"

namespace dyngs {

template <class S>
void project_forward(const GaussianViews<S>& in, const ProjectOptions<S>& options, const Projected<S>& out);
template <class S>
void project_backward(const GaussianViews<S>& in, const ProjectOptions<S>& options, const int32_t* radii,
                      const ProjectedGrads<S>& grads, const GaussianGrads<S>& out);

template <class S>
void harmonics_forward(const Harmonics<S>& in, S* colors);
// grad_centers (V, 3) may be null.
template <class S>
void harmonics_backward(const Harmonics<S>& in, const S* colors, const S* grad_colors, S* grad_means, S* grad_sh,
                        S* grad_centers);

// Throws std::length_error with the numbers if more than `max_entries` would be needed, before allocating them.
template <class S>
Binning bin_tiles(const Splats<S>& splats, int64_t max_entries);

template <class S>
void rasterize_forward(const Splats<S>& splats, const Entries& entries, const Image<S>& image);
template <class S>
void rasterize_backward(const Splats<S>& splats, const Entries& entries, const ImageGrads<S>& image,
                        const SplatGrads<S>& out);

}  // namespace dyngs
