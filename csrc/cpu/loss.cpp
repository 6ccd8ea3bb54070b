// Fused L1 + SSIM loss and its gradient, one pass over tiles that stay in the second-level cache.
//
// SSIM, its gradient and the letters d, s, G(.) are those of math/ssim.hpp.
//
// Precision. A tile with squares beyond kLargestSquaresInFloat anywhere, which no ordinary image has, is computed again in
// float64: 0.1% of Q are then reached at images of 1e5, and nothing overflows. The choice depends on the tile's pixels alone.
//
// Channels are interleaved: a row is 3 * width numbers, and the horizontal taps lie 3 numbers apart.
#include "core/api.hpp"

#include <algorithm>
#include <atomic>
#include <cmath>
#include <cstddef>
#include <cstring>
#include <memory>

#include "cpu/simd.hpp"
#include "math/ssim.hpp"

namespace dyngs {
namespace {

constexpr int kChannels = 3;
constexpr int kRadius = kSsimRadius, kTaps = kSsimTaps;

constexpr int kBatch = 4;                      // rows filtered together: each row read serves up to four sums
constexpr int kWindow = kBatch + 2 * kRadius;  // rows that a batch reads
constexpr int kRing = 16;                      // rows kept of each map; a power of two, at least kWindow
constexpr int kHalo = 2 * kRadius;             // a gradient depends on pixels this far away
constexpr int kTileRows = 96;
constexpr int kTilePixels = 256;

// Pixels [row_begin, row_end) x [col_begin, col_end). Tiles depend on the image only, never on the thread count.
struct Tile {
  int64_t row_begin, row_end, col_begin, col_end;
};

// Maps kept for the last kRing rows.
enum RingMap { kDifference, kSum, kWeight, kGradMean, kGradDifferenceSquare, kGradSumSquare, kRingMaps };
// Vertically blurred maps of the current batch; the adjoint pass reuses the first three.
enum ScratchMap { kMeanD, kMeanS, kSquareD, kSquareS, kScratchMaps };

// Row buffers of one thread. Number i of a row is number i of the image's row minus 3 * (tile.col_begin - kHalo), so
// that the tile itself starts at number kTileStart; everything outside the image holds zeros.
constexpr int kTileStart = kChannels * kHalo;

template <class T>
class Workspace {
 public:
  static int64_t size(int64_t max_tile_pixels) { return stride_for(max_tile_pixels) * kRows; }

  // `memory`: size(max_tile_pixels) numbers, set to zero here.
  Workspace(T* memory, int64_t max_tile_pixels) : stride_(stride_for(max_tile_pixels)), numbers_(memory) {
    std::memset(numbers_, 0, size(max_tile_pixels) * sizeof(T));
  }

  int64_t stride() const { return stride_; }
  T* ring(int map, int64_t row) { return numbers_ + (map * kRing + (row & (kRing - 1))) * stride_; }
  T* scratch(int map, int index) { return numbers_ + (kRingRows + map * kBatch + index) * stride_; }
  T* line() { return numbers_ + (kRows - 1) * stride_; }

 private:
  static constexpr int64_t kRingRows = kRingMaps * kRing;
  static constexpr int64_t kRows = kRingRows + kScratchMaps * kBatch + 1;
  static int64_t stride_for(int64_t max_tile_pixels) {
    constexpr int kWidth = Native<T>::kSize;
    return (kChannels * (max_tile_pixels + 2 * kHalo) + kWidth - 1) / kWidth * kWidth + kWidth;
  }
  int64_t stride_;
  T* numbers_;
};

// Data of one tile that the steps below share.
template <class T>
struct Context {
  const LossInput& input;
  const SsimKernel<T>& kernel;
  Tile tile;
  T scale;          // 1 / (channels * sum of the mask)
  float* gradient;  // nullptr: value only
  Workspace<T>& rows;
  Native<T> largest = {};  // G(d^2) + G(s^2) so far, lane by lane

  int64_t tile_numbers() const { return kChannels * (tile.col_end - tile.col_begin); }
  int64_t row_numbers() const { return tile_numbers() + 2 * kTileStart; }
};

template <class T>
bool is_precise(const Context<T>& c) {
  bool precise = true;
  for (int k = 0; k < Native<T>::kSize; ++k)
    precise = precise && c.largest[k] <= static_cast<T>(kLargestSquaresInFloat);
  return precise || sizeof(T) == sizeof(double);
}

struct Sums {
  double l1 = 0;
  double dissimilarity = 0;
};

// Sixteen independent sums, so that the compiler may vectorise without reordering a float sum.
template <class T, class Function>
double sum_of(int64_t count, Function value) {
  T lane[16] = {};
  int64_t i = 0;
  for (; i + 16 <= count; i += 16)
    for (int k = 0; k < 16; ++k) lane[k] += value(i + k);
  for (; i < count; ++i) lane[i % 16] += value(i);
  double sum = 0;
  for (int k = 0; k < 16; ++k) sum += lane[k];
  return sum;
}

template <class T>
void load_row(Context<T>& c, int64_t row) {
  T* difference = c.rows.ring(kDifference, row);
  T* sum = c.rows.ring(kSum, row);
  T* weight = c.rows.ring(kWeight, row);
  const size_t bytes = c.rows.stride() * sizeof(T);
  std::memset(difference, 0, bytes);
  std::memset(sum, 0, bytes);
  std::memset(weight, 0, bytes);
  if (row < 0 || row >= c.input.height) return;

  const int64_t first = std::max<int64_t>(c.tile.col_begin - kHalo, 0);
  const int64_t pixels = std::min(c.tile.col_end + kHalo, c.input.width) - first;
  const int64_t skip = kChannels * (first - (c.tile.col_begin - kHalo));
  const int64_t offset = row * c.input.width + first;
  difference += skip, sum += skip, weight += skip;
  if (c.input.mask) {
    const float* mask = c.input.mask + offset;
    for (int64_t p = 0; p < pixels; ++p)
      for (int k = 0; k < kChannels; ++k) weight[kChannels * p + k] = mask[p];
  } else {
    std::fill(weight, weight + kChannels * pixels, T(1));
  }
  const float* x = c.input.rendered + kChannels * offset;
  const float* y = c.input.target + kChannels * offset;
  for (int64_t i = 0; i < kChannels * pixels; ++i) {
    difference[i] = weight[i] * (static_cast<T>(x[i]) - static_cast<T>(y[i]));
    sum[i] = weight[i] * (static_cast<T>(x[i]) + static_cast<T>(y[i]));
  }
}

// Blurs the ring map around rows row .. row + kBatch - 1 down the columns, and its square too if asked for.
template <bool with_square, class T>
void blur_columns(Context<T>& c, int ring_map, int64_t row, int to, int square_to = 0) {
  const T* from[kWindow];
  for (int r = 0; r < kWindow; ++r) from[r] = c.rows.ring(ring_map, row - kRadius + r);
  for (int64_t i = 0; i < c.row_numbers(); i += Native<T>::kSize) {
    Native<T> sum[kBatch] = {}, square_sum[kBatch] = {};
#pragma GCC unroll 16
    for (int r = 0; r < kWindow; ++r) {
      const Native<T> x = load_native(from[r] + i), square = x * x;
#pragma GCC unroll 4
      for (int b = 0; b < kBatch; ++b) {
        if (r < b || r - b >= kTaps) continue;
        sum[b] += x * c.kernel.tap[r - b];
        if (with_square) square_sum[b] += square * c.kernel.tap[r - b];
      }
    }
    for (int b = 0; b < kBatch; ++b) {
      store(c.rows.scratch(to, b) + i, sum[b]);
      if (with_square) store(c.rows.scratch(square_to, b) + i, square_sum[b]);
    }
  }
}

template <class T>
inline Native<T> blur_along(const T* centre, const SsimKernel<T>& kernel) {
  Native<T> sum = load_native(centre) * kernel.tap[kRadius];
#pragma GCC unroll 8
  for (int k = 1; k <= kRadius; ++k)
    sum += (load_native(centre - kChannels * k) + load_native(centre + kChannels * k)) * kernel.tap[kRadius + k];
  return sum;
}

// Finishes the blur of one row along the row, and turns the four means into SSIM and its partial derivatives.
template <class T>
double ssim_row(Context<T>& c, int64_t row, int b) {
  const T* mean_d = c.rows.scratch(kMeanD, b);
  const T* mean_s = c.rows.scratch(kMeanS, b);
  const T* square_d = c.rows.scratch(kSquareD, b);
  const T* square_s = c.rows.scratch(kSquareS, b);
  const T* weight = c.rows.ring(kWeight, row);
  T* dissimilarity = c.rows.line();
  Native<T> largest = c.largest;
  for (int64_t i = kChannels * kRadius; i < c.row_numbers() - kChannels * kRadius; i += Native<T>::kSize) {
    const Native<T> e_d2 = blur_along(square_d + i, c.kernel), e_s2 = blur_along(square_s + i, c.kernel);
    const Native<T> squares = e_d2 + e_s2;
    largest = max(squares, largest);
    const SsimTerms<Native<T>> t =
        ssim_terms(blur_along(mean_d + i, c.kernel), blur_along(mean_s + i, c.kernel), e_d2, e_s2);
    const Native<T> w = load_native(weight + i);
    store(dissimilarity + i, w * t.dissimilarity);
    store(c.rows.ring(kGradMean, row) + i, w * t.grad_mean);
    store(c.rows.ring(kGradDifferenceSquare, row) + i, w * t.grad_diff_square);
    store(c.rows.ring(kGradSumSquare, row) + i, w * t.grad_sum_square);
  }
  c.largest = largest;
  if (row < c.tile.row_begin || row >= c.tile.row_end) return 0;
  return sum_of<T>(c.tile_numbers(), [=](int64_t i) { return dissimilarity[kTileStart + i]; });
}

// SSIM and its partial derivatives on rows row .. row + kBatch - 1; needs the rows kRadius around them.
template <class T>
double ssim_batch(Context<T>& c, int64_t row) {
  blur_columns<true>(c, kDifference, row, kMeanD, kSquareD);
  blur_columns<true>(c, kSum, row, kMeanS, kSquareS);
  double dissimilarity = 0;
  for (int b = 0; b < kBatch; ++b) {
    if (row + b >= 0 && row + b < c.input.height) {
      dissimilarity += ssim_row(c, row + b, b);
    } else {
      for (int map : {kGradMean, kGradDifferenceSquare, kGradSumSquare})
        std::memset(c.rows.ring(map, row + b), 0, c.rows.stride() * sizeof(T));
    }
  }
  return dissimilarity;
}

template <class T>
void write_gradient_row(Context<T>& c, int64_t row, const T* line) {
  float* to = c.gradient + kChannels * (row * c.input.width + c.tile.col_begin);
  std::copy(line + kTileStart, line + kTileStart + c.tile_numbers(), to);
}

template <class T>
void gradient_batch(Context<T>& c, int64_t row) {
  constexpr int kFromMean = 0, kFromDifference = 1, kFromSum = 2;
  blur_columns<false>(c, kGradMean, row, kFromMean);
  blur_columns<false>(c, kGradDifferenceSquare, row, kFromDifference);
  blur_columns<false>(c, kGradSumSquare, row, kFromSum);
  const T l1_scale = c.scale * (1 - c.input.ssim_weight), ssim_scale = c.scale * c.input.ssim_weight;
  for (int b = 0; b < kBatch && row + b < c.tile.row_end; ++b) {
    const T* difference = c.rows.ring(kDifference, row + b);
    const T* sum = c.rows.ring(kSum, row + b);
    const T* weight = c.rows.ring(kWeight, row + b);
    T* line = c.rows.line();
    for (int64_t i = kTileStart; i < c.row_numbers() - kTileStart; i += Native<T>::kSize) {
      const Native<T> d = load_native(difference + i), s = load_native(sum + i);
      const Native<T> ssim = ssim_grad(d, s, blur_along(c.rows.scratch(kFromMean, b) + i, c.kernel),
                                       blur_along(c.rows.scratch(kFromDifference, b) + i, c.kernel),
                                       blur_along(c.rows.scratch(kFromSum, b) + i, c.kernel));
      const Native<T> l1 = l1_scale * sign(d);
      store(line + i, load_native(weight + i) * (l1 - ssim_scale * ssim));
    }
    write_gradient_row(c, row + b, line);
  }
}

template <class T>
double l1_row(Context<T>& c, int64_t row) {
  const T* difference = c.rows.ring(kDifference, row) + kTileStart;
  return sum_of<T>(c.tile_numbers(), [=](int64_t i) { return std::fabs(difference[i]); });
}

template <class T>
Sums ssim_tile(Context<T>& c) {
  Sums sums;
  int64_t loaded = c.tile.row_begin - kHalo;       // rows before this one are in the ring
  int64_t ssim_done = c.tile.row_begin - kRadius;  // rows before this one have their partial derivatives in the ring
  for (int64_t row = c.tile.row_begin; row < c.tile.row_end; row += kBatch) {
    for (; ssim_done < row + kBatch + kRadius; ssim_done += kBatch) {
      for (; loaded < ssim_done + kBatch + kRadius; ++loaded) load_row(c, loaded);
      sums.dissimilarity += ssim_batch(c, ssim_done);
      if (!is_precise(c)) return sums;
    }
    for (int b = 0; b < kBatch && row + b < c.tile.row_end; ++b) sums.l1 += l1_row(c, row + b);
    if (c.gradient) gradient_batch(c, row);
  }
  return sums;
}

// Without SSIM no neighbours are needed.
template <class T>
Sums l1_tile(Context<T>& c) {
  Sums sums;
  for (int64_t row = c.tile.row_begin; row < c.tile.row_end; ++row) {
    load_row(c, row);
    sums.l1 += l1_row(c, row);
    if (!c.gradient) continue;
    T* line = c.rows.line();
    const T *difference = c.rows.ring(kDifference, row), *weight = c.rows.ring(kWeight, row);
    for (int64_t i = kTileStart; i < c.row_numbers() - kTileStart; i += Native<T>::kSize)
      store(line + i, c.scale * load_native(weight + i) * sign(load_native(difference + i)));
    write_gradient_row(c, row, line);
  }
  return sums;
}

// The sums in precision T; to be discarded unless is_precise(context) holds afterwards.
template <class T>
Sums tile_sums(Context<T>& c) {
  return c.input.ssim_weight == 0 ? l1_tile(c) : ssim_tile(c);
}

// Cuts `length` into equal pieces of at most `most`.
struct Pieces {
  int64_t length, count;
  Pieces(int64_t length_, int64_t most) : length(length_), count((length_ + most - 1) / most) {}
  int64_t begin(int64_t i) const { return length * i / count; }
  int64_t longest() const { return (length + count - 1) / count; }
};

double sum_of_mask(const LossInput& input) {
  if (!input.mask) return static_cast<double>(input.height) * static_cast<double>(input.width);
  double sum = 0;
  for (int64_t row = 0; row < input.height; ++row) {
    const float* mask = input.mask + row * input.width;
    sum += sum_of<float>(input.width, [=](int64_t i) { return mask[i]; });
  }
  return sum;
}

}  // namespace

double l1_ssim_loss(const LossInput& input, float* gradient, int threads) {
  const SsimKernel<float> kernel = ssim_kernel<float>();
  const SsimKernel<double> fine_kernel = ssim_kernel<double>();
  const Pieces strips(input.height, kTileRows), columns(input.width, kTilePixels);
  const double mask_sum = sum_of_mask(input);
  const double scale = mask_sum == 0 ? 0 : 1 / (kChannels * mask_sum);
  const int64_t num_tiles = strips.count * columns.count, widest = columns.longest();
  const std::unique_ptr<Sums[]> sums(new Sums[num_tiles]);
  // Allocated here, as no exception may leave the threads; the float64 rows, hardly ever needed, stay untouched.
  const int64_t floats = Workspace<float>::size(widest), doubles = Workspace<double>::size(widest);
  const std::unique_ptr<float[]> float_rows(new float[threads * floats]);
  const std::unique_ptr<double[]> double_rows(new double[threads * doubles]);
  std::atomic<int64_t> next{0};
#pragma omp parallel for num_threads(threads) schedule(static, 1)
  for (int thread = 0; thread < threads; ++thread) {
    Workspace<float> rows(float_rows.get() + thread * floats, widest);
    for (int64_t t = next++; t < num_tiles; t = next++) {
      const int64_t strip = t / columns.count, column = t % columns.count;
      const Tile tile{strips.begin(strip), strips.begin(strip + 1), columns.begin(column), columns.begin(column + 1)};
      Context<float> context{input, kernel, tile, static_cast<float>(scale), gradient, rows};
      sums[t] = tile_sums(context);
      if (is_precise(context)) continue;
      Workspace<double> fine_rows(double_rows.get() + thread * doubles, widest);
      Context<double> again{input, fine_kernel, tile, scale, gradient, fine_rows};
      sums[t] = tile_sums(again);
    }
  }
  Sums total;
  for (int64_t t = 0; t < num_tiles; ++t) {
    total.l1 += sums[t].l1;
    total.dissimilarity += sums[t].dissimilarity;
  }
  const double ssim_weight = input.ssim_weight;
  return scale * ((1 - ssim_weight) * total.l1 + (ssim_weight == 0 ? 0 : ssim_weight * total.dissimilarity));
}

}  // namespace dyngs
