// Smoothness and sparseness penalties of the planes with their gradient, in one pass over the memory.
//
// A plane is seen as rows of C-vectors. With the second differences d_i = p_(i-1) - 2 p_i + p_(i+1) along an axis (0
// for the first and last i), the derivative of sum_i d_i^2 is 2 (d_(i-1) - 2 d_i + d_(i+1)).
#include <algorithm>
#include <cmath>

#include "core/api.hpp"
#include "cpu/parallel.hpp"
#include "cpu/simd.hpp"
#include "math/planes.hpp"

namespace dyngs {
namespace {

constexpr int64_t kBandRows = 16;  // of work shared out; each end costs one more row of differences
constexpr int kAxes = 3;

// One plane (rows, row_size) with row_size = columns * channels, and the factors of its three sums.
template <class S>
struct Plane {
  const S* values;
  S* grad;  // or nullptr
  int64_t rows, columns, channels;
  PenaltyFactors factors;

  int64_t row_size() const { return columns * channels; }
};

// A running sum, lane by lane, and of the elements that do not fill a packet.
template <class S>
struct Sum {
  Packet<S> lanes{S(0)};
  double rest = 0;

  double total() const {
    double sum = rest;
    for (int i = 0; i < kLanes; ++i) sum += lanes[i];
    return sum;
  }
};

// Writes a - 2 b + c; returns the sum of its squares.
template <class S>
double differences(const S* a, const S* b, const S* c, S* to, int64_t n) {
  using P = Packet<S>;
  Sum<S> sum;
  int64_t k = 0;
  for (; k + kLanes <= n; k += kLanes) {
    const P d = second_difference(P::load(a + k), P::load(b + k), P::load(c + k));
    d.store(to + k);
    sum.lanes += d * d;
  }
  for (; k < n; ++k) {
    to[k] = second_difference(a[k], b[k], c[k]);
    sum.rest += double(to[k]) * to[k];
  }
  return sum.total();
}

// to (+)= factor * (a - 2 b + c)
template <bool accumulate, class S>
void gradient_row(const S* a, const S* b, const S* c, S factor, S* to, int64_t n) {
  using P = Packet<S>;
  int64_t k = 0;
  for (; k + kLanes <= n; k += kLanes) {
    const P g = second_difference_vjp(P::load(a + k), P::load(b + k), P::load(c + k), P(factor));
    (accumulate ? P::load(to + k) + g : g).store(to + k);
  }
  for (; k < n; ++k) {
    const S g = second_difference_vjp(a[k], b[k], c[k], factor);
    to[k] = accumulate ? to[k] + g : g;
  }
}

// Returns the sum of |1 - p|, and adds its gradient times factor unless `to` is nullptr.
template <class S>
double distance_from_one(const S* p, S factor, S* to, int64_t n) {
  using P = Packet<S>;
  const P one(S(1));
  Sum<S> sum;
  int64_t k = 0;
  for (; k + kLanes <= n; k += kLanes) {
    const P d = P::load(p + k) - one;
    sum.lanes += abs(d);
    if (to) (P::load(to + k) + distance_vjp(d, P(factor))).store(to + k);
  }
  for (; k < n; ++k) {
    const S d = p[k] - S(1);
    sum.rest += std::abs(d);
    if (to) to[k] += distance_vjp(d, factor);
  }
  return sum.total();
}

// The differences of three neighbouring rows, as a ring.
template <class S>
struct RowDifferences {
  const Plane<S>& plane;
  S* ring;

  S* at(int64_t row) { return ring + (row + 3) % 3 * plane.row_size(); }

  double compute(int64_t row) {
    const int64_t n = plane.row_size();
    if (row < 1 || row > plane.rows - 2) {
      std::fill_n(at(row), n, S(0));
      return 0;
    }
    const S* p = plane.values + row * n;
    return differences(p - n, p, p + n, at(row), n);
  }
};

// Size of the scratch memory of band_penalty.
template <class S>
int64_t room_for(const Plane<S>& plane) {
  return 4 * plane.row_size() + 2 * plane.channels;
}

// The penalty of rows [begin, end), and its gradient.
template <class S>
double band_penalty(const Plane<S>& plane, int64_t begin, int64_t end, S* room) {
  const int64_t n = plane.row_size(), channels = plane.channels;
  const S by_rows = static_cast<S>(2 * plane.factors.by_rows),
          by_columns = static_cast<S>(2 * plane.factors.by_columns);
  RowDifferences<S> down{plane, room};
  S* across = room + 3 * n + channels;  // differences along the row, with a zero before and after
  std::fill(across - channels, across + n + channels, S(0));
  double rows_sum = 0, columns_sum = 0, one_sum = 0;
  if (plane.grad) down.compute(begin - 1);
  rows_sum += down.compute(begin);
  for (int64_t row = begin; row < end; ++row) {
    const S* p = plane.values + row * n;
    S* to = plane.grad ? plane.grad + row * n : nullptr;
    if (row + 1 < end) {
      rows_sum += down.compute(row + 1);
    } else if (to) {
      down.compute(row + 1);
    }
    if (to) gradient_row<false>(down.at(row - 1), down.at(row), down.at(row + 1), by_rows, to, n);
    if (plane.factors.by_columns != 0 && plane.columns >= 3) {
      columns_sum += differences(p, p + channels, p + 2 * channels, across + channels, n - 2 * channels);
      if (to) gradient_row<true>(across - channels, across, across + channels, by_columns, to, n);
    }
    if (plane.factors.one != 0) one_sum += distance_from_one(p, static_cast<S>(plane.factors.one), to, n);
  }
  return plane.factors.by_rows * rows_sum + plane.factors.by_columns * columns_sum + plane.factors.one * one_sum;
}

template <class S>
std::vector<Plane<S>> all_planes(const HexPlane<S>& hexplane, const PenaltyWeights& weights,
                                 std::span<const PlaneGrads<S>> grads) {
  std::vector<Plane<S>> planes;
  const int64_t channels = hexplane.channels;
  for (size_t l = 0; l < hexplane.levels.size(); ++l) {
    const auto& level = hexplane.levels[l];
    const int64_t row = level.size * channels, space_size = level.size * row, time_size = level.times * row;
    const PenaltyFactors of_space = space_factors(weights.space, level.size, channels);
    const PenaltyFactors of_time = time_factors(weights.time, weights.one, level.times, level.size, channels);
    for (int p = 0; p < kAxes; ++p) {
      S* g_space = grads.empty() ? nullptr : grads[l].space + p * space_size;
      S* g_time = grads.empty() ? nullptr : grads[l].time + p * time_size;
      planes.push_back({level.space + p * space_size, g_space, level.size, level.size, channels, of_space});
      planes.push_back({level.time + p * time_size, g_time, level.times, level.size, channels, of_time});
    }
  }
  return planes;
}

}  // namespace

template <class S>
double plane_penalty(const HexPlane<S>& planes, const PenaltyWeights& weights, std::span<const PlaneGrads<S>> grads,
                     int threads) {
  struct Band {
    size_t plane;
    int64_t begin, end;
  };
  const auto arrays = all_planes(planes, weights, grads);
  std::vector<Band> bands;
  for (size_t p = 0; p < arrays.size(); ++p)
    for (int64_t row = 0; row < arrays[p].rows; row += kBandRows)
      bands.push_back({p, row, std::min(arrays[p].rows, row + kBandRows)});
  std::vector<double> sums(bands.size());
  int64_t most = 0;
  for (const auto& plane : arrays) most = std::max(most, room_for(plane));
  const auto room = for_each_worker<std::vector<S>>(threads, most);
  parallel_workers(static_cast<int64_t>(bands.size()), 1, threads, [&](int worker, int64_t b, int64_t) {
    sums[b] = band_penalty(arrays[bands[b].plane], bands[b].begin, bands[b].end, room[worker]->data());
  });
  double total = 0;
  for (const double sum : sums) total += sum;
  return total;
}

template double plane_penalty<float>(const HexPlane<float>&, const PenaltyWeights&, std::span<const PlaneGrads<float>>,
                                     int);
template double plane_penalty<double>(const HexPlane<double>&, const PenaltyWeights&,
                                      std::span<const PlaneGrads<double>>, int);

}  // namespace dyngs
