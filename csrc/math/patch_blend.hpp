// A pixel as the weighted mean of itself and its four neighbours, and the vjp. Both gather: each pixel and each crossing
// is written by one caller. `In` has the arrays of core/triangles.hpp's PatchImage.
#pragma once

#include "math/outline.hpp"

namespace dyngs {

// The places of a view around one of its pixels.
template <class S, class In>
class PixelStar {
 public:
  DYNGS_HD PixelStar(const In& in, int64_t view, int x, int y) : in_(in), view_(view), x_(x), y_(y), row_(at(x, y)) {
    S sum = S(0);
    for (int k = 0; k < kDirections; ++k) {
      shares_[k] = has(k) ? covered(k) : S(0);
      sum += shares_[k];
    }
    own_ = max(S(1) - sum, S(0));
    scale_ = S(1) / max(sum, S(1));
  }

  // Share of what it shows itself, and of what the neighbour `k` shows, of the pixel.
  DYNGS_HD S own() const { return own_ * scale_; }
  DYNGS_HD S share(int k) const { return shares_[k] * scale_; }
  // True if the neighbours cover the whole pixel or more.
  DYNGS_HD bool is_full() const { return !(own_ > S(0)); }
  DYNGS_HD S scale() const { return scale_; }

  DYNGS_HD bool has(int k) const { return inside(x_ + dx(k), y_ + dy(k)); }
  DYNGS_HD int64_t row() const { return row_; }
  DYNGS_HD int64_t row(int k) const { return at(x_ + dx(k), y_ + dy(k)); }
  DYNGS_HD PixelStar next(int k) const { return PixelStar(in_, view_, x_ + dx(k), y_ + dy(k)); }
  DYNGS_HD int64_t pixel() const { return index(x_, y_); }

  DYNGS_HD int channels() const { return in_.channels; }
  // Channel `c` of what a row shows; `c` = channels: whether it is nothing.
  DYNGS_HD S value(int64_t row, int c) const {
    if (c == in_.channels) return row < 0 ? S(1) : S(0);
    return row < 0 ? S(0) : S(in_.colours[row * in_.channels + c]);
  }
  DYNGS_HD S blended(int c) const {
    S sum = own() * value(row_, c);
    for (int k = 0; k < kDirections; ++k) {
      if (shares_[k] > S(0)) sum += share(k) * value(row(k), c);
    }
    return sum;
  }
  // Derivative of channel `c` by how much the neighbour `k` covers.
  DYNGS_HD S by_covered(int k, int c) const {
    return is_full() ? (value(row(k), c) - blended(c)) * scale_ : value(row(k), c) - value(row_, c);
  }
  // Slope of channel `c` along x (axis 0) or y, of the patch that the pixel shows.
  DYNGS_HD S slope(int axis, int c) const {
    const int64_t after = same(2 * axis), before = same(2 * axis + 1);
    if (after == before) return S(0);
    const S rise = value(after, c) - value(before, c);
    return after != row_ && before != row_ ? rise * S(0.5) : rise;
  }
  // How much the neighbour `k` covers of the pixel.
  DYNGS_HD S covered(int k) const {
    const S t = in_.crossings[crossing(k)];
    return k % 2 == 0 ? covered_of_first(t) : covered_of_second(t);
  }
  // How much the pixel covers of the neighbour `k`.
  DYNGS_HD S covers(int k) const {
    const S t = in_.crossings[crossing(k)];
    return k % 2 == 0 ? covered_of_second(t) : covered_of_first(t);
  }
  // Index of the crossing towards the neighbour `k`.
  DYNGS_HD int64_t crossing(int k) const {
    const int64_t plane = int64_t{in_.width} * in_.height;
    const int x = k == 1 ? x_ - 1 : x_, y = k == 3 ? y_ - 1 : y_;
    return (2 * view_ + k / 2) * plane + int64_t{y} * in_.width + x;
  }

 private:
  static DYNGS_HD int dx(int k) { return k == 0 ? 1 : k == 1 ? -1 : 0; }
  static DYNGS_HD int dy(int k) { return k == 2 ? 1 : k == 3 ? -1 : 0; }
  DYNGS_HD bool inside(int x, int y) const { return x >= 0 && y >= 0 && x < in_.width && y < in_.height; }
  DYNGS_HD int64_t index(int x, int y) const { return (view_ * in_.height + y) * in_.width + x; }
  DYNGS_HD int64_t at(int x, int y) const { return in_.rows[index(x, y)]; }
  // The row of the neighbour `k` if it is of the same patch, else the own one.
  DYNGS_HD int64_t same(int k) const {
    const int64_t found = has(k) ? row(k) : int64_t{-1};
    return found >= 0 && row_ >= 0 && in_.ids[found] == in_.ids[row_] ? found : row_;
  }

  const In& in_;
  int64_t view_;
  int x_, y_;
  int64_t row_;
  S shares_[kDirections], own_, scale_;
};

// Gradient by channel `c` of what a pixel shows; `g(pixel, c)`: that by the image.
template <class S, class In, class G>
DYNGS_HD S gathered(const PixelStar<S, In>& star, const G& g, int c) {
  S sum = star.own() * g(star.pixel(), c);
  for (int k = 0; k < kDirections; ++k) {
    if (!star.has(k) || !(star.covers(k) > S(0))) continue;
    const PixelStar<S, In> other = star.next(k);
    sum += other.share(k ^ 1) * g(other.pixel(), c);
  }
  return sum;
}

// Gradient by the crossing towards the neighbour `k`, which is to the right or below: of both pixels, of which it
// covers at most one partly.
template <class S, class In, class G>
DYNGS_HD S crossing_grad(const PixelStar<S, In>& star, const G& g, int k) {
  const bool first = star.covered(k) > S(0), second = star.covers(k) > S(0);
  S sum = S(0);
  if (first) {
    for (int c = 0; c <= star.channels(); ++c) sum -= g(star.pixel(), c) * star.by_covered(k, c);
  }
  if (second) {
    const PixelStar<S, In> other = star.next(k);
    for (int c = 0; c <= star.channels(); ++c) sum += g(other.pixel(), c) * other.by_covered(k ^ 1, c);
  }
  return sum;
}

}  // namespace dyngs
