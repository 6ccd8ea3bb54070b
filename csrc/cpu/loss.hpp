// Fused L1 + SSIM loss of one picture, with its gradient.
#pragma once

#include <cstdint>

namespace dyngs {

struct LossInput {
  const float* rendered;  // (height, width, 3)
  const float* target;    // (height, width, 3)
  const float* mask;      // (height, width) weights, or nullptr for all ones
  int64_t height;
  int64_t width;
  float ssim_weight;
};

// Returns (1 - ssim_weight) * mean|x - y| + ssim_weight * (1 - mean SSIM(x, y)), both means weighted by the mask.
// Writes d loss / d rendered into `gradient` (height, width, 3) unless that is nullptr.
// The result does not depend on num_threads. A mask without any weight gives 0 and a zero gradient.
double l1_ssim_loss(const LossInput& input, float* gradient, int num_threads);

}  // namespace dyngs
