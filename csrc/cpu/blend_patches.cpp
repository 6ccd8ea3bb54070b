// Pixels as weighted means of the Gaussians of the pixels around them. Bands of rows are tasks; in the vjp each has sums of
// its own of the rows around it, too, which are added up band by band: the same bytes on any number of threads.
#include <algorithm>
#include <cmath>
#include <vector>

#include "core/triangles.hpp"
#include "cpu/parallel.hpp"
#include "math/outline.hpp"

namespace dyngs {
namespace {

constexpr int kBand = 16;        // rows
constexpr double kWindow = 2.5;  // half side of the window of Gaussians, in standard deviations
constexpr int kMostWindow = 4;   // that in pixels
constexpr int kMostLabels = (2 * kMostWindow + 1) * (2 * kMostWindow + 1);
constexpr double kLeastSum = 1e-6;  // below which nothing is drawn

// What the pixels of a view show: patches, -1 for nothing, and which of them lie on an outline or near one.
template <class S>
class Labels {
 public:
  Labels(const PatchImage<S>& in, int64_t view)
      : in_(in),
        rows_(in.rows + view * in.width * in.height),
        window_(window_of(in.sigma)),
        search_(static_cast<int>(std::ceil(in.radius)) + 1),
        labels_(pixels()),
        outline_(pixels()),
        near_(pixels()) {
    for (int64_t i = 0; i < pixels(); ++i) labels_[i] = rows_[i] < 0 ? -1 : in.ids[rows_[i]];
    parallel_for(in.height, kBand, in.threads, [&](int64_t begin, int64_t end) {
      for (int y = static_cast<int>(begin); y < end; ++y) mark_outline(y);
    });
    parallel_for(in.height, kBand, in.threads, [&](int64_t begin, int64_t end) {
      for (int y = static_cast<int>(begin); y < end; ++y) mark_near(y);
    });
  }

  static int window_of(S sigma) { return std::min(kMostWindow, static_cast<int>(std::ceil(kWindow * sigma))); }

  int64_t pixels() const { return int64_t{in_.width} * in_.height; }
  int reach() const { return std::max(window_, search_); }
  int32_t label(int64_t pixel) const { return labels_[pixel]; }
  int32_t row(int64_t pixel) const { return rows_[pixel]; }
  bool is_near(int64_t pixel) const { return near_[pixel]; }
  // Whether all around a pixel shows nothing.
  bool is_empty(int64_t pixel) const { return labels_[pixel] < 0 && !near_[pixel]; }

  // Where the Gaussian of a pixel at column i and row j is, relative to the centre of pixel (x, y).
  Vec2<S> offset(int64_t pixel, int i, int j, int x, int y) const {
    const int32_t row = rows_[pixel];
    return row < 0 ? Vec2<S>{S(i - x), S(j - y)} : mean_from(row, x, y);
  }
  // The same of row `row` of the means.
  Vec2<S> mean_from(int64_t row, int x, int y) const {
    return {in_.means[2 * row] - (S(x) + S(0.5)), in_.means[2 * row + 1] - (S(y) + S(0.5))};
  }

  // f(pixel, column, row) of the pixels in the window of Gaussians, row by row.
  template <class F>
  void for_window(int x, int y, F&& f) const {
    for_square(x, y, window_, f);
  }
  // The same of those on an outline in the window that is searched for the nearest.
  template <class F>
  void for_outline(int x, int y, F&& f) const {
    for_square(x, y, search_, [&](int64_t pixel, int i, int j) {
      if (outline_[pixel]) f(pixel, i, j);
    });
  }

 private:
  template <class F>
  void for_square(int x, int y, int half, F&& f) const {
    for (int j = std::max(0, y - half); j <= std::min(in_.height - 1, y + half); ++j) {
      for (int i = std::max(0, x - half); i <= std::min(in_.width - 1, x + half); ++i)
        f(int64_t{j} * in_.width + i, i, j);
    }
  }
  void mark_outline(int y) {
    for (int x = 0; x < in_.width; ++x) {
      const int64_t own = int64_t{y} * in_.width + x;
      bool differs = false;
      for_square(x, y, 1, [&](int64_t pixel, int, int) { differs |= labels_[pixel] != labels_[own]; });
      outline_[own] = differs;
    }
  }
  void mark_near(int y) {
    for (int x = 0; x < in_.width; ++x) {
      bool found = false;
      for_square(x, y, reach(), [&](int64_t pixel, int, int) { found |= outline_[pixel] != 0; });
      near_[int64_t{y} * in_.width + x] = found;
    }
  }

  const PatchImage<S>& in_;
  const int32_t* rows_;
  int window_, search_;
  std::vector<int32_t> labels_;
  std::vector<uint8_t> outline_, near_;
};

// How much each patch in the window of a pixel counts there, by its nearest point of an outline.
template <class S>
class PixelWeights {
 public:
  void find(const PatchImage<S>& in, const Labels<S>& labels, int x, int y) {
    count_ = 0;
    const int32_t own = labels.label(int64_t{y} * in.width + x);
    int place = 0;
    labels.for_window(x, y, [&](int64_t pixel, int, int) {
      const int32_t label = labels.label(pixel);
      int at = slot(label);
      if (at < 0) at = count_, labels_[at] = label, square_[at] = kLargest<S>, nearest_[at] = -1, ++count_;
      slots_[place++] = at;
    });
    labels.for_outline(x, y, [&](int64_t pixel, int i, int j) {
      const int at = slot(labels.label(pixel));
      if (at < 0) return;
      const Vec2<S> d = labels.offset(pixel, i, j, x, y);
      const S square = d.x * d.x + d.y * d.y;
      if (square < square_[at]) square_[at] = square, nearest_[at] = pixel;
    });
    for (int i = 0; i < count_; ++i) {
      rho_[i] = std::sqrt(square_[i]) / in.radius;
      weights_[i] = outline_weight(labels_[i] == own, rho_[i]);
    }
  }

  // The slot of the n-th pixel of the window.
  int slot_at(int n) const { return slots_[n]; }
  S weight(int slot) const { return weights_[slot]; }

  // f(pixel, gradient by its mean) for each point of an outline that weights depend on; by_weight: of each slot.
  template <class F>
  void vjp(const PatchImage<S>& in, const Labels<S>& labels, int x, int y, const S* by_weight, F&& f) const {
    const int32_t own = labels.label(int64_t{y} * in.width + x);
    for (int i = 0; i < count_; ++i) {
      const S distance = rho_[i] * in.radius;
      if (!(rho_[i] < S(1)) || labels_[i] < 0 || distance < S(kOnOutline)) continue;
      const S by_distance = by_weight[i] * outline_slope(labels_[i] == own, rho_[i]) / in.radius;
      const Vec2<S> d = labels.mean_from(labels.row(nearest_[i]), x, y);
      f(nearest_[i], Vec2<S>{by_distance * d.x / distance, by_distance * d.y / distance});
    }
  }

 private:
  // -1 where no pixel of the window has the label.
  int slot(int32_t label) const {
    for (int i = 0; i < count_; ++i) {
      if (labels_[i] == label) return i;
    }
    return -1;
  }

  int count_ = 0;
  int slots_[kMostLabels];
  int32_t labels_[kMostLabels];
  int64_t nearest_[kMostLabels];
  S square_[kMostLabels], rho_[kMostLabels], weights_[kMostLabels];
};

template <class S>
S gaussian(const PatchImage<S>& in, const Vec2<S>& d) {
  return std::exp(S(-0.5) * (d.x * d.x + d.y * d.y) / (in.sigma * in.sigma));
}

// f(pixel, offset, Gaussian, slot) for each Gaussian around a pixel; `weights` are found first where an outline is near.
template <class S, class F>
void for_each_gaussian(const PatchImage<S>& in, const Labels<S>& labels, int x, int y, PixelWeights<S>& weights,
                       F&& f) {
  const bool near = labels.is_near(int64_t{y} * in.width + x);
  if (near) weights.find(in, labels, x, y);
  int place = 0;
  labels.for_window(x, y, [&](int64_t pixel, int i, int j) {
    const Vec2<S> d = labels.offset(pixel, i, j, x, y);
    f(pixel, d, gaussian(in, d), near ? weights.slot_at(place++) : -1);
  });
}

template <class S>
void blend_pixel(const PatchImage<S>& in, const Labels<S>& labels, int x, int y, PixelWeights<S>& weights,
                 const BlendedPatches<S>& out, int64_t at) {
  S sum = 0, behind = 0, colour[kMostPatchChannels] = {};
  if (labels.is_empty(int64_t{y} * in.width + x)) {
    std::fill_n(out.image + at * in.channels, in.channels, S(0));
    out.transmittance[at] = S(1), out.sums[at] = S(0);
    return;
  }
  for_each_gaussian(in, labels, x, y, weights, [&](int64_t pixel, const Vec2<S>&, S value, int slot) {
    const S weight = slot < 0 ? value : value * weights.weight(slot);
    const int32_t row = labels.row(pixel);
    sum += weight;
    if (row < 0) behind += weight;
    for (int c = 0; row >= 0 && c < in.channels; ++c) colour[c] += weight * in.colours[int64_t{row} * in.channels + c];
  });
  const bool drawn = sum >= S(kLeastSum);
  for (int c = 0; c < in.channels; ++c) out.image[at * in.channels + c] = drawn ? colour[c] / sum : S(0);
  out.transmittance[at] = drawn ? behind / sum : S(1);
  out.sums[at] = sum;
}

// Gradients by means and colours of the rows of a band and those around it.
template <class S>
class BandGrads {
 public:
  BandGrads(const PatchImage<S>& in, int y0, int reach)
      : first_(std::max(0, y0 - reach)),
        last_(std::min(in.height, y0 + kBand + reach)),
        width_(in.width),
        size_(in.channels + 2),
        sums_(static_cast<size_t>(last_ - first_) * width_ * size_) {}

  // By x and y of the mean, then by the colour.
  S* of(int64_t pixel) { return sums_.data() + (pixel - int64_t{first_} * width_) * size_; }
  bool has_row(int y) const { return y >= first_ && y < last_; }

 private:
  int first_, last_, width_, size_;
  std::vector<S> sums_;
};

template <class S>
struct PixelGrad {
  const S* image;  // (C,) of the pixel
  S transmittance;
};

template <class S>
void blend_pixel_vjp(const PatchImage<S>& in, const Labels<S>& labels, int x, int y, PixelWeights<S>& weights,
                     const BlendedPatches<const S>& out, const PixelGrad<S>& g, int64_t at, BandGrads<S>& grads) {
  const S sum = out.sums[at];
  if (!(sum >= S(kLeastSum))) return;
  S mean = g.transmittance * out.transmittance[at];
  for (int c = 0; c < in.channels; ++c) mean += g.image[c] * out.image[at * in.channels + c];
  S by_weight[kMostLabels] = {};
  const S narrow = S(1) / (in.sigma * in.sigma);
  for_each_gaussian(in, labels, x, y, weights, [&](int64_t pixel, const Vec2<S>& d, S value, int slot) {
    const S weight = slot < 0 ? S(1) : weights.weight(slot);
    const int32_t row = labels.row(pixel);
    S own = row < 0 ? g.transmittance : S(0);
    for (int c = 0; row >= 0 && c < in.channels; ++c) own += g.image[c] * in.colours[int64_t{row} * in.channels + c];
    const S by_product = (own - mean) / sum;
    if (slot >= 0) by_weight[slot] += by_product * value;
    if (row < 0) return;
    S* to = grads.of(pixel);
    const S share = weight * value, by_offset = -by_product * share * narrow;
    to[0] += by_offset * d.x, to[1] += by_offset * d.y;
    for (int c = 0; c < in.channels; ++c) to[2 + c] += share / sum * g.image[c];
  });
  if (!labels.is_near(int64_t{y} * in.width + x)) return;
  weights.vjp(in, labels, x, y, by_weight, [&](int64_t pixel, const Vec2<S>& by_mean) {
    S* to = grads.of(pixel);
    to[0] += by_mean.x, to[1] += by_mean.y;
  });
}

// Writes the gradients of the Gaussians of a band, summed over all bands that have some, in their order.
template <class S>
void gather(const PatchImage<S>& in, const Labels<S>& labels, int band, std::vector<BandGrads<S>>& bands, S* g_means,
            S* g_colours) {
  for (int y = band * kBand; y < std::min(in.height, (band + 1) * kBand); ++y) {
    for (int64_t pixel = int64_t{y} * in.width; pixel < int64_t{y + 1} * in.width; ++pixel) {
      const int64_t row = labels.row(pixel);
      for (size_t b = 0; row >= 0 && b < bands.size(); ++b) {
        if (!bands[b].has_row(y)) continue;
        const S* from = bands[b].of(pixel);
        g_means[2 * row] += from[0], g_means[2 * row + 1] += from[1];
        for (int c = 0; c < in.channels; ++c) g_colours[row * in.channels + c] += from[2 + c];
      }
    }
  }
}

template <class S, class F>
void for_each_pixel(const PatchImage<S>& in, int64_t view, int64_t first_row, int64_t end_row, F&& f) {
  for (int y = static_cast<int>(first_row); y < end_row; ++y) {
    for (int x = 0; x < in.width; ++x) f(x, y, (view * in.height + y) * in.width + x);
  }
}

}  // namespace

template <class S>
void blend_patches_forward(const PatchImage<S>& in, const BlendedPatches<S>& out) {
  for (int64_t view = 0; view < in.views; ++view) {
    const Labels<S> labels(in, view);
    parallel_for(in.height, kBand, in.threads, [&](int64_t begin, int64_t end) {
      PixelWeights<S> weights;
      for_each_pixel(in, view, begin, end,
                     [&](int x, int y, int64_t at) { blend_pixel(in, labels, x, y, weights, out, at); });
    });
  }
}

template <class S>
void blend_patches_backward(const PatchImage<S>& in, const BlendedPatches<const S>& out, const S* g_image,
                            const S* g_transmittance, S* g_means, S* g_colours) {
  std::fill_n(g_means, 2 * in.count, S(0));
  std::fill_n(g_colours, in.channels * in.count, S(0));
  for (int64_t view = 0; view < in.views; ++view) {
    const Labels<S> labels(in, view);
    std::vector<BandGrads<S>> bands;
    for (int y = 0; y < in.height; y += kBand) bands.emplace_back(in, y, labels.reach());
    parallel_for(in.height, kBand, in.threads, [&](int64_t begin, int64_t end) {
      PixelWeights<S> weights;
      for_each_pixel(in, view, begin, end, [&](int x, int y, int64_t at) {
        const PixelGrad<S> g{g_image + at * in.channels, g_transmittance[at]};
        blend_pixel_vjp(in, labels, x, y, weights, out, g, at, bands[begin / kBand]);
      });
    });
    parallel_for(static_cast<int64_t>(bands.size()), 1, in.threads,
                 [&](int64_t band, int64_t) { gather(in, labels, static_cast<int>(band), bands, g_means, g_colours); });
  }
}

#define DYNGS_INSTANTIATE(S)                                                                                        \
  template void blend_patches_forward<S>(const PatchImage<S>&, const BlendedPatches<S>&);                           \
  template void blend_patches_backward<S>(const PatchImage<S>&, const BlendedPatches<const S>&, const S*, const S*, \
                                          S*, S*);
DYNGS_INSTANTIATE(float)
DYNGS_INSTANTIATE(double)
#undef DYNGS_INSTANTIATE

}  // namespace dyngs
