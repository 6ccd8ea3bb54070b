// Fused Adam (math/adam.hpp): one pass over the memory instead of torch's eight, whole vectors even where rows are short.
//
// The work is cut into blocks of rows. Where few rows of a block are to be updated and rows are long, that is done run by
// run, which saves the memory traffic of the rows between; otherwise element by element under a mask, which keeps whole
// vectors busy.
#include "core/api.hpp"

#include <algorithm>
#include <cmath>
#include <cstring>
#include <memory>

#include "math/adam.hpp"

namespace dyngs {
namespace {

constexpr int64_t kBlockFloats = 2048;  // four arrays of it fit the first-level cache
constexpr int64_t kLongRow = 16;        // floats; from here on a row alone fills vectors
constexpr int64_t kSparse = 3;          // runs pay where fewer than one row in three is updated

using Coefficients = AdamCoefficients<float>;

// Pointers to a piece of the four arrays; `step` holds the bias-corrected rate of each element.
struct Piece {
  float* param;
  const float* grad;
  float* exp_avg;
  float* exp_avg_sq;
  const float* step;
};

// Updates `count` elements. Pointers are parameters, not members: only then does GCC believe __restrict and vectorise.
// `active` (one int per element, 0 = leave alone) is read only if masked.
template <bool masked>
void update_floats(float* __restrict param, const float* __restrict grad, float* __restrict exp_avg,
                   float* __restrict exp_avg_sq, const float* __restrict step, const int32_t* __restrict active,
                   int64_t count, Coefficients c) {
  for (int64_t i = 0; i < count; ++i) {
    const AdamElement<float> old{param[i], exp_avg[i], exp_avg_sq[i]}, next = adam_update(old, grad[i], step[i], c);
    const bool on = !masked || active[i] != 0;
    exp_avg[i] = on ? next.exp_avg : old.exp_avg;
    exp_avg_sq[i] = on ? next.exp_avg_sq : old.exp_avg_sq;
    param[i] = on ? next.param : old.param;
  }
}

template <bool masked>
void update(const Piece& piece, const int32_t* active, int64_t count, const Coefficients& c) {
  update_floats<masked>(piece.param, piece.grad, piece.exp_avg, piece.exp_avg_sq, piece.step, active, count, c);
}

// True if no element is NaN or at least 2^63 in magnitude. The square of such an element would make the second moment
// infinite and freeze the parameter. Without their sign, floats sort as integers, NaN on top.
bool all_usable(const float* x, int64_t count) {
  constexpr int32_t kMagnitude = 0x7fffffff, kTooLarge = 0x5f000000;
  int32_t bad = 0;
  for (int64_t i = 0; i < count; ++i) {
    int32_t bits;
    std::memcpy(&bits, x + i, sizeof bits);
    bad |= (bits & kMagnitude) >= kTooLarge;
  }
  return bad == 0;
}

// True if all elements are zero, of either sign.
bool all_zero(const float* x, int64_t count) {
  uint32_t magnitude = 0;
  for (int64_t i = 0; i < count; ++i) {
    uint32_t bits;
    std::memcpy(&bits, x + i, sizeof bits);
    magnitude |= bits << 1;
  }
  return magnitude == 0;
}

// A block of rows, at most Plan::rows_per_block of them.
struct Block {
  int64_t first_row;
  int64_t num_rows;
};

// Data that all threads share.
struct Plan {
  const AdamState& state;
  const AdamRates& rates;
  Coefficients coefficients;
  int64_t rows_per_block;
  std::unique_ptr<float[]> step;  // the rates of a whole block, bias-corrected

  Piece piece(int64_t row) const {
    const int64_t at = row * state.row_size;
    return {state.param + at, state.grad + at, state.exp_avg + at, state.exp_avg_sq + at, step.get()};
  }
};

Plan make_plan(const AdamState& state, const AdamRates& rates) {
  const double correction1 = 1 - std::pow(rates.beta1, static_cast<double>(rates.step));
  const double correction2 = 1 - std::pow(rates.beta2, static_cast<double>(rates.step));
  const Coefficients coefficients{static_cast<float>(1 - rates.beta1), static_cast<float>(rates.beta2),
                                  static_cast<float>(1 - rates.beta2), static_cast<float>(1 / std::sqrt(correction2)),
                                  static_cast<float>(rates.eps)};
  const int64_t rows_per_block = std::max<int64_t>(1, kBlockFloats / state.row_size);
  Plan plan{state, rates, coefficients, rows_per_block,
            std::unique_ptr<float[]>(new float[rows_per_block * state.row_size])};
  float* step = plan.step.get();
  for (int64_t i = 0; i < state.row_size; ++i) step[i] = static_cast<float>(rates.column_rates[i] / correction1);
  const int64_t rows = std::min(rows_per_block, state.num_rows);
  for (int64_t row = 1; row < rows; ++row) std::copy_n(step, state.row_size, step + row * state.row_size);
  return plan;
}

// Clears active[r] of rows with a gradient that cannot be used; returns how many.
int64_t drop_unusable(const Plan& plan, Block block, bool* active) {
  const int64_t size = plan.state.row_size;
  const float* grad = plan.state.grad + block.first_row * size;
  int64_t dropped = 0;
  for (int64_t r = 0; r < block.num_rows; ++r) {
    if (!active[r] || all_usable(grad + r * size, size)) continue;
    active[r] = false;
    ++dropped;
  }
  return dropped;
}

void update_runs(const Plan& plan, Block block, const bool* active) {
  for (int64_t r = 0; r < block.num_rows;) {
    int64_t end = r;
    while (end < block.num_rows && active[end]) ++end;
    if (end > r) {
      const int64_t count = (end - r) * plan.state.row_size;
      update<false>(plan.piece(block.first_row + r), nullptr, count, plan.coefficients);
    }
    r = end + 1;
  }
}

void update_masked(const Plan& plan, Block block, const bool* active) {
  int32_t element_active[kBlockFloats];
  const int64_t size = plan.state.row_size;
  for (int64_t r = 0; r < block.num_rows; ++r)
    for (int64_t i = 0; i < size; ++i) element_active[r * size + i] = active[r];
  update<true>(plan.piece(block.first_row), element_active, block.num_rows * size, plan.coefficients);
}

void update_all(const Plan& plan, Block block) {
  update<false>(plan.piece(block.first_row), nullptr, block.num_rows * plan.state.row_size, plan.coefficients);
}

int64_t update_block(const Plan& plan, Block block) {
  const int64_t size = plan.state.row_size;
  const bool* rows = plan.rates.rows;
  bool active[kBlockFloats];
  if (rows != nullptr) {
    std::memcpy(active, rows + block.first_row, block.num_rows);
  } else {
    std::memset(active, true, block.num_rows);
  }
  // If rows are long and few are updated, only the gradients of those are read.
  const bool check_each = rows != nullptr && size >= kLongRow;
  const bool check = check_each || !all_usable(plan.state.grad + block.first_row * size, block.num_rows * size);
  const int64_t skipped = check ? drop_unusable(plan, block, active) : 0;

  int64_t num_active = 0;
  for (int64_t r = 0; r < block.num_rows; ++r) num_active += active[r];
  if (num_active == block.num_rows) {
    update_all(plan, block);
  } else if (size >= kLongRow && num_active < block.num_rows / kSparse) {
    update_runs(plan, block, active);
  } else if (num_active > 0) {
    update_masked(plan, block, active);
  }
  return skipped;
}

}  // namespace

int64_t adam_step(const AdamState& state, const AdamRates& rates, int threads) {
  if (state.num_rows == 0 || state.row_size == 0) return 0;
  const Plan plan = make_plan(state, rates);
  const int64_t num_blocks = (state.num_rows + plan.rows_per_block - 1) / plan.rows_per_block;
  int64_t skipped = 0;
#pragma omp parallel for num_threads(threads) schedule(dynamic, 8) reduction(+ : skipped)
  for (int64_t b = 0; b < num_blocks; ++b) {
    const int64_t first = b * plan.rows_per_block;
    skipped += update_block(plan, {first, std::min(plan.rows_per_block, state.num_rows - first)});
  }
  return skipped;
}

void seen_rows(const float* grads, int64_t num_rows, int64_t row_size, bool* seen, int threads) {
#pragma omp parallel for num_threads(threads) schedule(static)
  for (int64_t row = 0; row < num_rows; ++row) {
    const float* grad = grads + row * row_size;
    seen[row] =
        row_size > 0 &&
        (grad[0] != 0 || !all_zero(grad, row_size));  // where there is a gradient, mostly the first number shows it
  }
}

}  // namespace dyngs
