// What a colour network is told about each Gaussian that an eye sees (dyngs/ops/shading.py has the formulas in torch).
#pragma once

#include <cstdint>

namespace dyngs {

template <class S>
struct Shading {
  int64_t rows;
  const int64_t* picked;                     // (rows) which Gaussians
  const S *means, *quats, *log_scales;       // (N, 3), (N, 4), (N, 3)
  const S* base;                             // (rows, 3) colours
  const S* eye;                              // (3)
  const S* box;                              // (2, 3) centre and half sides
  const S* places;                           // (N, 3) at rest, or nullptr: the means
  const S* turn;                             // (3, 3) from rest to the world, or nullptr
  bool normals, timed;
  S time;                                    // in [-1, 1]
  int threads;

  int64_t width() const { return 9 + 4 * normals + timed; }
};

// Writes (rows, width): place, direction, what the normal says, base colour, time.
template <class S>
void shading_inputs(const Shading<S>& in, S* out);

}  // namespace dyngs
