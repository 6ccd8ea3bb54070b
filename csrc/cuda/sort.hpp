// Prefix sums, and a stable sort of pairs by the bits of a key. Both give the same bytes every time: blocks only meet at the ends
// of launches, and the only atomics count.
#pragma once

#include <algorithm>
#include <bit>

#include "cuda/device.hpp"

namespace dyngs::cuda {

// The memory that the functions below need for up to `count` items.
struct ScanScratch {
  int64_t* partials;  // per block
  int64_t* total;     // (1,)
  ScanScratch(Workspace& workspace, int64_t count);
};

// Replaces counts[i] by the sum of all before it, and writes the sum of all to scratch.total. The sums must fit 32 bits;
// the total may be larger, and is then the only thing of use.
void exclusive_scan(int32_t* counts, int64_t count, const ScanScratch& scratch, Stream stream);

struct SortScratch {
  int32_t* histogram;
  ScanScratch scan;
  SortScratch(Workspace& workspace, int64_t count);
};

struct Pairs {
  uint32_t* keys;
  int32_t* values;
};

// Eight bits of the key are sorted in one pass.
inline constexpr int kRadixBits = 8;
inline int bits_for(int64_t keys) {  // of the largest of so many keys
  return std::max(1, static_cast<int>(std::bit_width(static_cast<uint64_t>(std::max<int64_t>(keys, 1) - 1))));
}
inline int passes_for(int bits) { return (bits + kRadixBits - 1) / kRadixBits; }

// Sorts by the lowest `bits` bits, ties in the order they came. Passes go to and fro between `from` and `other`; the result
// lies in `from` after an even number of them, else in `other`: in the one that is returned.
const Pairs& stable_sort(const Pairs& from, const Pairs& other, int64_t count, int bits, const SortScratch& scratch,
                         Stream stream);

// Writes for each key below `num_keys` the place of its first one in a sorted list, and the number of all after that: (num_keys + 1).
void find_offsets(const uint32_t* keys, int64_t count, int64_t num_keys, int32_t* offsets, Stream stream);

// The place of the first key that is not below `key`.
__device__ inline int64_t first_of(const uint32_t* keys, int64_t count, int64_t key) {
  int64_t lo = 0, hi = count;
  while (lo < hi) {
    const int64_t middle = (lo + hi) / 2;
    if (static_cast<int64_t>(static_cast<uint32_t>(global(keys)[middle])) < key) {
      lo = middle + 1;
    } else {
      hi = middle;
    }
  }
  return lo;
}

}  // namespace dyngs::cuda
