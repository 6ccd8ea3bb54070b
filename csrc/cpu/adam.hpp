// One Adam step over an array seen as rows.
#pragma once

#include <cstdint>

namespace dyngs {

// Arrays of num_rows x row_size floats, updated in place except for the gradient.
struct AdamState {
  float* param;
  const float* grad;
  float* exp_avg;
  float* exp_avg_sq;
  int64_t num_rows;
  int64_t row_size;
};

struct AdamRates {
  const float* column_rates;  // (row_size,) learning rates
  const bool* rows;           // (num_rows,) rows to update, or nullptr for all
  double beta1;
  double beta2;
  double eps;
  int64_t step;  // 1 for the first update
};

// Updates the rows asked for whose gradient is below 2^63 throughout, and leaves value and moments of all others as they are.
// Returns the number of rows that were asked for but had NaN, infinity or a larger gradient.
int64_t adam_step(const AdamState& state, const AdamRates& rates, int num_threads);

// Sets seen[r] where row r of grads (num_rows, row_size) has an element other than zero; NaN counts as such.
void seen_rows(const float* grads, int64_t num_rows, int64_t row_size, bool* seen, int num_threads);

}  // namespace dyngs
