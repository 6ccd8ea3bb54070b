// The CUDA kernels of the perceptron, run by the emulation of cuda_on_cpu.hpp with all its checks, or on a GPU
// (tests/GPU.hpp): against the CPU's in float64, and bit by bit against themselves under other orders of blocks and threads.
#include <algorithm>
#include <cmath>
#include <limits>
#include <stdexcept>

#include "tests/check.hpp"
#include "tests/gpu.hpp"

namespace {

using namespace dyngs;
using namespace check;

struct NetworkCase {
  std::vector<int64_t> widths;
  int64_t skip, rows;
  Values params, x, g_y;
};

NetworkCase network_case(const std::vector<int64_t>& widths, int64_t skip, int64_t rows) {
  const int64_t params = Perceptron<double>{widths, skip, nullptr, 1}.num_params();
  return {widths,
          skip,
          rows,
          uniforms(params, -0.4, 0.4),
          uniforms(rows * widths.front(), -1, 1),
          uniforms(rows * widths.back(), -1, 1)};
}

template <class S>
struct NetworkResults {
  std::vector<S> y, by_x, by_params;
};

NetworkResults<double> network_on_cpu(const NetworkCase& c) {
  NetworkResults<double> r{Values(c.g_y.size()), Values(c.x.size()), Values(c.params.size())};
  const Perceptron<double> net{c.widths, c.skip, c.params.data(), 1};
  perceptron_forward<double>(net, c.rows, c.x.data(), r.y.data(), nullptr);
  perceptron_backward<double>(net, c.rows, c.x.data(), c.g_y.data(), nullptr, r.by_x.data(), r.by_params.data());
  return r;
}

// `bytes` for rows at a time.
NetworkResults<float> network_on_gpu(const NetworkCase& c, bool with_x = true, int64_t bytes = cuda::kPerceptronBytes) {
  Memory<float> params(as<float>(c.params)), x(as<float>(c.x)), g_y(as<float>(c.g_y));
  Memory<float> y(g_y.count()), by_x(x.count()), by_params(params.count());
  const Perceptron<float> net{c.widths, c.skip, params.get(), 1};
  Memory<char> forward(cuda::perceptron_forward_workspace(net));
  Memory<char> backward(cuda::perceptron_backward_workspace(net, c.rows, bytes));
  cuda::perceptron_forward(net, c.rows, x.get(), y.get(), {forward.get(), forward.count()}, nullptr);
  cuda::perceptron_backward(net, c.rows, x.get(), g_y.get(), with_x ? by_x.get() : nullptr, by_params.get(),
                            {backward.get(), backward.count()}, nullptr, bytes);
  return {y.values(), by_x.values(), by_params.values()};
}

void test_perceptron(const std::vector<int64_t>& widths, int64_t skip, int64_t rows) {
  const NetworkCase c = network_case(widths, skip, rows);
  std::string what = std::to_string(rows) + " rows through";
  for (const int64_t width : widths) what += " " + std::to_string(width);
  const NetworkResults<float> gpu = network_on_gpu(c);
  const NetworkResults<double> cpu = network_on_cpu(c);
  expect_close("outputs, " + what, gpu.y, cpu.y, 5e-6);
  expect_close("gradient by inputs, " + what, gpu.by_x, cpu.by_x, 5e-6);
  expect_close("gradient by parameters, " + what, gpu.by_params, cpu.by_params, 2e-5);
  in_other_orders([&] {
    const NetworkResults<float> again = network_on_gpu(c);
    expect_same_bits("outputs again, " + what, again.y, gpu.y);
    expect_same_bits("gradient by inputs again, " + what, again.by_x, gpu.by_x);
    expect_same_bits("gradient by parameters again, " + what, again.by_params, gpu.by_params);
  });
  expect_same_bits("gradient by parameters alone, " + what, network_on_gpu(c, false).by_params, gpu.by_params);
  for (const int64_t bytes : {1, 200'000}) {  // one tile at a time, some
    const NetworkResults<float> in_parts = network_on_gpu(c, true, bytes);
    expect_same_bits("gradient by inputs in parts, " + what, in_parts.by_x, gpu.by_x);
    expect_close("gradient by parameters in parts, " + what, in_parts.by_params, cpu.by_params, 2e-5);
  }
}

void test_no_rows() {
  const NetworkResults<float> gpu = network_on_gpu(network_case({5, 8, 3}, 0, 0));
  expect(std::all_of(gpu.by_params.begin(), gpu.by_params.end(), [](float x) { return x == 0; }),
         "no rows, no gradients by parameters");
}

// More tiles than sums, in the smallest tiles.
void test_many_tiles() {
  const NetworkCase c = network_case({250, 250, 256}, 1, 100);
  const NetworkResults<float> gpu = network_on_gpu(c);
  const NetworkResults<double> cpu = network_on_cpu(c);
  expect_close("outputs of many tiles", gpu.y, cpu.y, 5e-6);
  expect_close("gradient by inputs of many tiles", gpu.by_x, cpu.by_x, 5e-6);
  expect_close("gradient by parameters of many tiles", gpu.by_params, cpu.by_params, 2e-5);
}

// A row with NaN has NaN in its outputs, and no other row has.
void test_nan_row() {
  NetworkCase c = network_case({5, 8, 8, 3}, 0, 40);
  const NetworkResults<float> good = network_on_gpu(c);
  c.x[7 * 5 + 2] = std::numeric_limits<double>::quiet_NaN();
  const NetworkResults<float> bad = network_on_gpu(c);
  for (size_t at = 0; at < good.y.size(); ++at)
    expect(at / 3 == 7 ? std::isnan(bad.y[at]) : bad.y[at] == good.y[at], "NaN in its own row alone");
}

// Padding rows, whose outputs are infinite here, are not part of any sum.
void test_padding() {
  const NetworkCase c{{1, 1, 1, 1}, 0, 3, {-1e30, 1e30, 1e30, 1, 1, 0}, {1, 1, 1}, {1, 1, 1}};
  const NetworkResults<float> gpu = network_on_gpu(c);
  expect(gpu.y == std::vector<float>{1, 1, 1}, "outputs beside rows that are none");
  expect(gpu.by_params == std::vector<float>{0, 0, 0, 3, 3, 3}, "gradient by parameters beside rows that are none");
}

void test_large_networks() {
  const std::vector<int64_t> deep(18, 2), wide{3, 257, 3}, largest(17, 256);
  const auto fits = [](const std::vector<int64_t>& w) { return cuda::perceptron_fits({w, 1, nullptr, 1}); };
  expect(fits(largest) && !fits(deep) && !fits(wide), "which networks fit");
  expect(cuda::perceptron_forward_workspace({largest, 1, nullptr, 1}) > 0, "the largest one has a plan");
  bool refused = false;
  try {
    cuda::perceptron_forward_workspace({wide, 0, nullptr, 1});
  } catch (const std::length_error&) {
    refused = true;
  }
  expect(refused, "a network that does not fit is refused");
}

}  // namespace

int main() {
  skip_without_gpu();
  test_perceptron({5, 24, 24, 3}, 2, 301), test_perceptron({4, 1}, 0, 30), test_perceptron({13, 32, 32, 3}, 0, 700);
  test_perceptron({33, 70, 41, 70, 9}, 3, 150), test_perceptron({100, 256, 130, 11}, 2, 37);
  test_no_rows(), test_many_tiles(), test_nan_row(), test_padding(), test_large_networks();
  return report();
}
