// L1 + SSIM and its gradient; SSIM, its gradient and the letters d, s, G(.) are those of math/ssim.hpp. A block of 256 threads
// computes 16x16 pixels, one channel after the other: it copies d and s of the pixels and 5 around them to shared memory, blurs
// rows and then columns. Two passes: SSIM and its partial derivatives, kept in a workspace, then their blurs.
//
// Precision: as on the CPU, tiles with squares beyond kLargestSquaresInFloat are computed again in double, with neighbours from the
// images themselves. Blocks of these two kernels (`fine`) find at once that there is nothing to do for all other tiles.
//
// Limits, H100 (3.35 TB/s, 67 TFLOP/s), per pixel of three channels: 24 bytes read and 36 written, then 36 + 24 read and 12
// written, and a mask twice 4: 140 bytes, 42 ps; about 3 (26/16 x 88 + 44 + 26/16 x 33 + 33 + 80) = 1100 operations, 16 ps: bound
// by memory, 1 megapixel no faster than 42 us. The halo is read from the second-level cache.
#include "cuda/api.hpp"
#include "cuda/reduce.hpp"
#include "math/ssim.hpp"

namespace dyngs::cuda {
namespace {

constexpr int kChannels = 3;
constexpr int kSide = 16, kThreads = kSide * kSide;
constexpr int kWindow = kSide + 2 * kSsimRadius;        // pixels that the SSIM of a tile depends on, each way
constexpr int kFineWindow = kWindow + 2 * kSsimRadius;  // those that its gradient depends on
enum Map { kGradMean, kGradDiffSquare, kGradSumSquare, kMaps };

// Sums over a tile, or over all.
struct TileSums {
  double l1, dissimilarity, mask;
};

struct Buffers {
  float* maps;      // (kMaps, H, W, 3): partial derivatives of SSIM, weighted
  TileSums* sums;   // (tiles)
  TileSums* total;  // (1)
  int32_t* flags;   // (tiles): 1 where float is not precise
  int64_t bytes;
  Buffers(Workspace&& w, int64_t height, int64_t width)
      : maps(w.take<float>(kMaps * height * width * kChannels)),
        sums(w.take<TileSums>(blocks_for(height, kSide) * blocks_for(width, kSide))),
        total(w.take<TileSums>(1)),
        flags(w.take<int32_t>(blocks_for(height, kSide) * blocks_for(width, kSide))),
        bytes(w.taken()) {}
};

struct TilePixels {
  int64_t x0, y0, columns, rows;  // first pixel; tiles of the image
};
__device__ TilePixels place(const LossInput& in) {
  const int64_t columns = (in.width + kSide - 1) / kSide, rows = (in.height + kSide - 1) / kSide;
  return {blockIdx.x % columns * kSide, blockIdx.x / columns * kSide, columns, rows};
}

// The index of a pixel, or -1 outside the image.
__device__ int64_t pixel_at(const LossInput& in, int64_t x, int64_t y) {
  return x >= 0 && x < in.width && y >= 0 && y < in.height ? y * in.width + x : -1;
}

__device__ float weight_of(const LossInput& in, int64_t pixel) {
  return in.mask != nullptr ? static_cast<float>(global(in.mask)[pixel]) : 1.f;
}

template <class T>
struct DiffSum {
  T d, s;
};
// Zeros outside the image.
template <class T>
__device__ DiffSum<T> load(const LossInput& in, int64_t pixel, int channel) {
  if (pixel < 0) return {T(0), T(0)};
  const T weight = weight_of(in, pixel), x = global(in.rendered)[pixel * kChannels + channel];
  const T y = global(in.target)[pixel * kChannels + channel];
  return {weight * (x - y), weight * (x + y)};
}

// Blurs `kCount` maps of kWindow x kWindow down to kWindow rows of kSide; square: their squares too, as maps kCount and on.
template <int kCount, bool kSquare>
__device__ void blur_rows(const Array<const float>& window, const SsimKernel<float>& kernel, const Array<float>& rows) {
  constexpr int kSize = kWindow * kSide;
  for (int i = static_cast<int>(threadIdx.x); i < kSize; i += kThreads) {
    const int from = i / kSide * kWindow + i % kSide;
    DYNGS_UNROLL
    for (int m = 0; m < kCount; ++m) {
      float sum = 0.f, squares = 0.f;
      DYNGS_UNROLL
      for (int t = 0; t < kSsimTaps; ++t) {
        const float value = window[m * kWindow * kWindow + from + t];
        sum += kernel.tap[t] * value;
        if (kSquare) squares += kernel.tap[t] * (value * value);
      }
      rows[m * kSize + i] = sum;
      if (kSquare) rows[(kCount + m) * kSize + i] = squares;
    }
  }
}

// The blur of map m at this thread's pixel.
__device__ float blur_column(const Array<const float>& rows, int m, const SsimKernel<float>& kernel) {
  float sum = 0.f;
  DYNGS_UNROLL
  for (int t = 0; t < kSsimTaps; ++t)
    sum += kernel.tap[t] * rows[m * kWindow * kSide + t * kSide + static_cast<int>(threadIdx.x)];
  return sum;
}

// `maps` null: the value only.
template <bool kSsim>
__global__ void __launch_bounds__(kThreads)
    loss_kernel(LossInput in, SsimKernel<float> kernel, float* maps, TileSums* sums, int32_t* flags) {
  DYNGS_SHARED(float, window, 2 * kWindow * kWindow);
  DYNGS_SHARED(float, rows, 4 * kWindow * kSide);
  DYNGS_SHARED(double, warp_sums, kThreads / kWarpSize);
  const TilePixels tile = place(in);
  const int thread = static_cast<int>(threadIdx.x);
  const int64_t pixel = pixel_at(in, tile.x0 + thread % kSide, tile.y0 + thread / kSide);
  const float weight = pixel >= 0 ? weight_of(in, pixel) : 0.f;
  float l1 = 0.f, dissimilarity = 0.f;
  bool precise = true;
  for (int c = 0; c < kChannels; ++c) {
    l1 += abs(load<float>(in, pixel, c).d);
    if constexpr (kSsim) {
      for (int i = thread; i < kWindow * kWindow; i += kThreads) {
        const int64_t x = tile.x0 - kSsimRadius + i % kWindow, y = tile.y0 - kSsimRadius + i / kWindow;
        const DiffSum<float> at = load<float>(in, pixel_at(in, x, y), c);
        window[i] = at.d, window[kWindow * kWindow + i] = at.s;
      }
      __syncthreads();
      blur_rows<2, true>(window, kernel, rows);
      __syncthreads();
      const float square_d = blur_column(rows, 2, kernel), square_s = blur_column(rows, 3, kernel);
      if (square_d + square_s > static_cast<float>(kLargestSquaresInFloat)) precise = false;
      const SsimTerms<float> t =
          ssim_terms(blur_column(rows, 0, kernel), blur_column(rows, 1, kernel), square_d, square_s);
      dissimilarity += weight * t.dissimilarity;
      if (maps != nullptr && pixel >= 0) {
        const Array<float> to = global(maps) + pixel * kChannels + c;
        const int64_t size = in.height * in.width * kChannels;
        to[kGradMean * size] = weight * t.grad_mean;
        to[kGradDiffSquare * size] = weight * t.grad_diff_square;
        to[kGradSumSquare * size] = weight * t.grad_sum_square;
      }
    }
  }
  const bool all_precise = __syncthreads_and(precise) != 0;
  const double sum_l1 = block_sum(static_cast<double>(l1), warp_sums);
  const double sum_dissimilarity = block_sum(static_cast<double>(pixel >= 0 ? dissimilarity : 0.f), warp_sums);
  const double sum_mask = block_sum(static_cast<double>(weight), warp_sums);
  if (thread != 0) return;
  global(sums)[blockIdx.x] = {sum_l1, sum_dissimilarity, sum_mask};
  global(flags)[blockIdx.x] = all_precise ? 0 : 1;
}

// One block: the sums of all tiles, in a fixed order, and the loss.
__global__ void __launch_bounds__(kThreads)
    total_kernel(const TileSums* sums, int64_t tiles, float ssim_weight, TileSums* total, double* loss) {
  DYNGS_SHARED(double, warp_sums, kThreads / kWarpSize);
  TileSums mine{0, 0, 0};
  for (int64_t t = threadIdx.x; t < tiles; t += kThreads) {
    const TileSums of_tile = global(sums)[t];
    mine.l1 += of_tile.l1, mine.dissimilarity += of_tile.dissimilarity, mine.mask += of_tile.mask;
  }
  const double l1 = block_sum(mine.l1, warp_sums), dissimilarity = block_sum(mine.dissimilarity, warp_sums);
  const double mask = block_sum(mine.mask, warp_sums);
  if (threadIdx.x != 0) return;
  const double scale = mask == 0 ? 0 : 1 / (kChannels * mask), weight = ssim_weight;
  global(total)[0] = {l1, dissimilarity, mask};
  global(loss)[0] = scale * ((1 - weight) * l1 + (weight == 0 ? 0 : weight * dissimilarity));
}

// d loss / d rendered of one pixel, of its d and s and the blurred partial derivatives.
template <class T>
__device__ float gradient_of(const LossInput& in, double mask_sum, T weight, const DiffSum<T>& at,
                             const T (&blurred)[kMaps]) {
  const T scale = static_cast<T>(mask_sum == 0 ? 0 : 1 / (kChannels * mask_sum)), ssim_weight = in.ssim_weight;
  const T l1 = scale * (T(1) - ssim_weight) * sign(at.d);
  if (ssim_weight == T(0)) return static_cast<float>(weight * l1);
  const T ssim = ssim_grad(at.d, at.s, blurred[kGradMean], blurred[kGradDiffSquare], blurred[kGradSumSquare]);
  return static_cast<float>(weight * (l1 - scale * ssim_weight * ssim));
}

// True if float precision is too low for this tile or a neighbour.
__device__ bool beside_flag(const TilePixels& tile, const int32_t* flags) {
  const int64_t column = blockIdx.x % tile.columns, row = blockIdx.x / tile.columns;
  bool flagged = false;
  for (int64_t r = max(row - 1, int64_t{0}); r <= min(row + 1, tile.rows - 1); ++r)
    for (int64_t c = max(column - 1, int64_t{0}); c <= min(column + 1, tile.columns - 1); ++c)
      flagged |= global(flags)[r * tile.columns + c] != 0;
  return flagged;
}

template <bool kSsim>
__global__ void __launch_bounds__(kThreads)
    gradient_kernel(LossInput in, SsimKernel<float> kernel, const float* maps, const TileSums* total, float* gradient) {
  DYNGS_SHARED(float, window, kMaps * kWindow * kWindow);
  DYNGS_SHARED(float, rows, kMaps * kWindow * kSide);
  const TilePixels tile = place(in);
  const int thread = static_cast<int>(threadIdx.x);
  const int64_t pixel = pixel_at(in, tile.x0 + thread % kSide, tile.y0 + thread / kSide);
  const TileSums sums = global(total)[0];
  for (int c = 0; c < kChannels; ++c) {
    float blurred[kMaps] = {};
    if constexpr (kSsim) {
      for (int i = thread; i < kWindow * kWindow; i += kThreads) {
        const int64_t from = pixel_at(in, tile.x0 - kSsimRadius + i % kWindow, tile.y0 - kSsimRadius + i / kWindow);
        for (int m = 0; m < kMaps; ++m)
          window[m * kWindow * kWindow + i] =
              from < 0 ? 0.f : static_cast<float>(global(maps)[(m * in.height * in.width + from) * kChannels + c]);
      }
      __syncthreads();
      blur_rows<kMaps, false>(window, kernel, rows);
      __syncthreads();
      for (int m = 0; m < kMaps; ++m) blurred[m] = blur_column(rows, m, kernel);
    }
    if (pixel >= 0)
      global(gradient)[pixel * kChannels + c] =
          gradient_of(in, sums.mask, weight_of(in, pixel), load<float>(in, pixel, c), blurred);
  }
}

// The blurs of d, s and their squares about (x, y) of a window `side` wide, in double, as SSIM and its partial derivatives.
__device__ SsimTerms<double> fine_terms(const Array<const double>& window, int side, int x, int y,
                                        const SsimKernel<double>& kernel) {
  double mean_d = 0, mean_s = 0, square_d = 0, square_s = 0;
  for (int r = 0; r < kSsimTaps; ++r)
    for (int t = 0; t < kSsimTaps; ++t) {
      const int from = (y - kSsimRadius + r) * side + x - kSsimRadius + t;
      const double tap = kernel.tap[r] * kernel.tap[t], d = window[from], s = window[side * side + from];
      mean_d += tap * d, mean_s += tap * s, square_d += tap * (d * d), square_s += tap * (s * s);
    }
  return ssim_terms(mean_d, mean_s, square_d, square_s);
}

__device__ void load_fine_window(const LossInput& in, const TilePixels& tile, int halo, int channel,
                                 const Array<double>& window) {
  const int side = kSide + 2 * halo;
  for (int i = static_cast<int>(threadIdx.x); i < side * side; i += kThreads) {
    const DiffSum<double> at =
        load<double>(in, pixel_at(in, tile.x0 - halo + i % side, tile.y0 - halo + i / side), channel);
    window[i] = at.d, window[side * side + i] = at.s;
  }
}

// The sums of a tile that is not precise in float.
__global__ void __launch_bounds__(kThreads)
    fine_loss_kernel(LossInput in, SsimKernel<double> kernel, const int32_t* flags, TileSums* sums) {
  DYNGS_SHARED(double, window, 2 * kWindow * kWindow);
  DYNGS_SHARED(double, warp_sums, kThreads / kWarpSize);
  if (global(flags)[blockIdx.x] == 0) return;
  const TilePixels tile = place(in);
  const int thread = static_cast<int>(threadIdx.x), x = thread % kSide, y = thread / kSide;
  const int64_t pixel = pixel_at(in, tile.x0 + x, tile.y0 + y);
  double l1 = 0, dissimilarity = 0;
  for (int c = 0; c < kChannels; ++c) {
    load_fine_window(in, tile, kSsimRadius, c, window);
    __syncthreads();
    if (pixel >= 0) {
      l1 += abs(load<double>(in, pixel, c).d);
      dissimilarity += double{weight_of(in, pixel)} *
                       fine_terms(window, kWindow, x + kSsimRadius, y + kSsimRadius, kernel).dissimilarity;
    }
    __syncthreads();
  }
  const double sum_l1 = block_sum(l1, warp_sums), sum_dissimilarity = block_sum(dissimilarity, warp_sums);
  if (thread == 0)
    global(sums)[blockIdx.x] = {sum_l1, sum_dissimilarity, static_cast<TileSums>(global(sums)[blockIdx.x]).mask};
}

// The gradient of a tile that has such a tile beside it, or is one.
__global__ void __launch_bounds__(kThreads)
    fine_gradient_kernel(LossInput in, SsimKernel<double> kernel, const int32_t* flags, const TileSums* total,
                         float* gradient) {
  DYNGS_SHARED(double, window, 2 * kFineWindow * kFineWindow);
  DYNGS_SHARED(double, maps, kMaps * kWindow * kWindow);
  const TilePixels tile = place(in);
  if (!beside_flag(tile, flags)) return;
  const int thread = static_cast<int>(threadIdx.x);
  const int64_t pixel = pixel_at(in, tile.x0 + thread % kSide, tile.y0 + thread / kSide);
  const TileSums sums = global(total)[0];
  for (int c = 0; c < kChannels; ++c) {
    load_fine_window(in, tile, 2 * kSsimRadius, c, window);
    __syncthreads();
    for (int i = thread; i < kWindow * kWindow; i += kThreads) {
      const int x = i % kWindow, y = i / kWindow;
      const int64_t at = pixel_at(in, tile.x0 - kSsimRadius + x, tile.y0 - kSsimRadius + y);
      const double weight = at < 0 ? 0 : double{weight_of(in, at)};
      SsimTerms<double> t{};
      if (at >= 0) t = fine_terms(window, kFineWindow, x + kSsimRadius, y + kSsimRadius, kernel);
      maps[kGradMean * kWindow * kWindow + i] = weight * t.grad_mean;
      maps[kGradDiffSquare * kWindow * kWindow + i] = weight * t.grad_diff_square;
      maps[kGradSumSquare * kWindow * kWindow + i] = weight * t.grad_sum_square;
    }
    __syncthreads();
    double blurred[kMaps] = {};
    for (int m = 0; m < kMaps; ++m)
      for (int r = 0; r < kSsimTaps; ++r)
        for (int t = 0; t < kSsimTaps; ++t)
          blurred[m] += kernel.tap[r] * kernel.tap[t] *
                        maps[m * kWindow * kWindow + (thread / kSide + r) * kWindow + thread % kSide + t];
    if (pixel >= 0)
      global(gradient)[pixel * kChannels + c] =
          gradient_of(in, sums.mask, double{weight_of(in, pixel)}, load<double>(in, pixel, c), blurred);
  }
}

}  // namespace

int64_t l1_ssim_loss_workspace(int64_t height, int64_t width) {
  return Buffers(Workspace(nullptr, 0), height, width).bytes;
}

void l1_ssim_loss(const LossInput& in, double* loss, float* gradient, const Lent& workspace, Stream stream) {
  const Buffers b(Workspace(workspace.memory, workspace.bytes), in.height, in.width);
  const int64_t tiles = blocks_for(in.height, kSide) * blocks_for(in.width, kSide);
  const bool ssim = in.ssim_weight != 0;
  const SsimKernel<float> kernel = ssim_kernel<float>();
  const SsimKernel<double> fine_kernel = ssim_kernel<double>();
  launch("loss", {tiles, kThreads}, stream, ssim ? loss_kernel<true> : loss_kernel<false>, in, kernel,
         gradient == nullptr ? nullptr : b.maps, b.sums, b.flags);
  if (ssim)
    launch("fine_loss", {tiles, kThreads}, stream, fine_loss_kernel, in, fine_kernel,
           static_cast<const int32_t*>(b.flags), b.sums);
  launch("total", {1, kThreads}, stream, total_kernel, static_cast<const TileSums*>(b.sums), tiles, in.ssim_weight,
         b.total, loss);
  if (gradient == nullptr) return;
  launch("gradient", {tiles, kThreads}, stream, ssim ? gradient_kernel<true> : gradient_kernel<false>, in, kernel,
         static_cast<const float*>(b.maps), static_cast<const TileSums*>(b.total), gradient);
  if (ssim)  // overwrites some of it
    launch("fine_gradient", {tiles, kThreads}, stream, fine_gradient_kernel, in, fine_kernel,
           static_cast<const int32_t*>(b.flags), static_cast<const TileSums*>(b.total), gradient);
}

}  // namespace dyngs::cuda
