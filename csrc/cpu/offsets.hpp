// Gaussians of which some are moved by what a deformation field says (dyngs/deform/field.py has the formulas in torch).
#pragma once

#include <cstdint>

namespace dyngs {

// Of `count` rows; null: no change of that.
template <class S>
struct RowOffsets {
  int64_t count;
  const int64_t* rows;  // null: the first ones
  const S *means, *quats, *log_scales, *logit_opacities, *colors;
};

template <class S>
struct MovedGaussians {
  S *means, *quats, *log_scales, *logit_opacities, *sh;
  int64_t sh_stride;  // scalars per Gaussian
};

// Adds the offsets in place. Rotations are turned by identity + offset, not normalised. No row may occur twice.
template <class S>
void add_offsets(const RowOffsets<S>& offsets, const MovedGaussians<S>& gaussians, int threads);

}  // namespace dyngs
