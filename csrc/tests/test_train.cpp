// The training kernels as a program without Python: the loss and its gradient against the plain formula in double, Adam
// against its formula, many threads against one.
#include <cmath>
#include <limits>
#include <memory>

#include "core/api.hpp"
#include "tests/check.hpp"

namespace {

using namespace dyngs;
using namespace check;

struct Images {
  int64_t height, width;
  Values rendered, target, mask;
  double ssim_weight;
};

// The blur of channel c around pixel (row, col) with zeros outside, of f(pixel index).
template <class F>
double blurred(const Images& p, int64_t row, int64_t col, F&& f) {
  double sum = 0, total = 0;
  for (int i = -5; i <= 5; ++i)
    for (int j = -5; j <= 5; ++j) {
      const double tap = std::exp(-(i * i + j * j) / (2 * 1.5 * 1.5));
      total += tap;
      if (row + i >= 0 && row + i < p.height && col + j >= 0 && col + j < p.width)
        sum += tap * f((row + i) * p.width + col + j);
    }
  return sum / total;
}

// The terms of one pixel in the sums of |x - y| and of 1 - SSIM.
double pixel_loss(const Images& p, int64_t row, int64_t col) {
  const double weight = p.mask[row * p.width + col];
  double loss = 0;
  for (int c = 0; c < 3; ++c) {
    const auto x = [&](int64_t i) { return p.mask[i] * p.rendered[3 * i + c]; };
    const auto y = [&](int64_t i) { return p.mask[i] * p.target[3 * i + c]; };
    const double mx = blurred(p, row, col, x), my = blurred(p, row, col, y);
    const double xx = blurred(p, row, col, [&](int64_t i) { return x(i) * x(i); }) - mx * mx;
    const double yy = blurred(p, row, col, [&](int64_t i) { return y(i) * y(i); }) - my * my;
    const double xy = blurred(p, row, col, [&](int64_t i) { return x(i) * y(i); }) - mx * my;
    const double ssim = (2 * mx * my + 1e-4) * (2 * xy + 9e-4) / ((mx * mx + my * my + 1e-4) * (xx + yy + 9e-4));
    const int64_t i = row * p.width + col;
    loss += (1 - p.ssim_weight) * std::abs(x(i) - y(i)) + p.ssim_weight * weight * (1 - ssim);
  }
  return loss;
}

// The loss of the pixels at most 10 from (row, col), to which those around contribute, too; times 3 sum(mask).
double plain_loss(const Images& p, int64_t row_begin, int64_t row_end, int64_t col_begin, int64_t col_end) {
  double loss = 0;
  for (int64_t row = std::max<int64_t>(row_begin, 0); row < std::min(row_end, p.height); ++row)
    for (int64_t col = std::max<int64_t>(col_begin, 0); col < std::min(col_end, p.width); ++col)
      loss += pixel_loss(p, row, col);
  return loss;
}

void test_loss(int64_t height, int64_t width, double ssim_weight, bool masked) {
  Images p{height,
           width,
           uniforms(3 * height * width, 0, 1),
           uniforms(3 * height * width, 0, 1),
           masked ? uniforms(height * width, 0, 1) : Values(height * width, 1),
           ssim_weight};
  const auto x = as<float>(p.rendered), y = as<float>(p.target), mask = as<float>(p.mask);
  const LossInput input{x.data(), y.data(), masked ? mask.data() : nullptr,
                        height,   width,    static_cast<float>(ssim_weight)};
  std::vector<float> gradient(x.size()), again(x.size());
  const double loss = l1_ssim_loss(input, gradient.data(), 1);
  const std::string what = std::to_string(width) + "x" + std::to_string(height);
  const double four = l1_ssim_loss(input, again.data(), 4);
  expect(loss == four && loss == l1_ssim_loss(input, nullptr, 2),
         "the loss is the same on any number of threads " + what);
  expect_same_bits("gradient of the loss on 4 threads " + what, gradient, again);
  double weights = 0;
  for (double m : p.mask) weights += m;
  p.ssim_weight = static_cast<float>(ssim_weight);
  if (height * width < 3000)
    expect_close("loss " + what, Values{loss}, Values{plain_loss(p, 0, height, 0, width) / (3 * weights)}, 1e-5);
  Values got, wanted;
  for (int k = 0; k < 4; ++k) {
    const int64_t row = (k * 53) % height, col = (k * 131) % width, i = 3 * (row * width + col) + k % 3;
    const double keep = p.rendered[i], h = 1e-6;
    const auto near = [&](double value) {
      p.rendered[i] = value;
      return plain_loss(p, row - 5, row + 6, col - 5, col + 6);
    };
    got.push_back(gradient[i]);
    wanted.push_back((near(keep + h) - near(keep - h)) / (2 * h * 3 * weights));
    p.rendered[i] = keep;
  }
  expect_close("gradient of the loss " + what, got, wanted, 1e-4);
}

struct Moments {
  Values param, first, second;
};

void plain_adam(Moments& m, const Values& grad, const Values& rates, const std::vector<char>& active, int64_t step) {
  const int64_t size = static_cast<int64_t>(rates.size());
  for (int64_t i = 0; i < static_cast<int64_t>(grad.size()); ++i) {
    if (!active[i / size]) continue;
    m.first[i] = 0.9 * m.first[i] + 0.1 * grad[i];
    m.second[i] = 0.999 * m.second[i] + 0.001 * grad[i] * grad[i];
    const double mean = m.first[i] / (1 - std::pow(0.9, step)), square = m.second[i] / (1 - std::pow(0.999, step));
    m.param[i] -= rates[i % size] * mean / (std::sqrt(square) + 1e-8);
  }
}

void test_adam(int64_t rows, int64_t size, double share) {
  const Values start = uniforms(rows * size, -1, 1), rates = uniforms(size, 1e-3, 1e-2);
  Moments plain{start, Values(start.size()), Values(start.size())};
  const auto float_rates = as<float>(rates);
  std::vector<float> param[2], first[2], second[2];
  for (int k = 0; k < 2; ++k)
    param[k] = as<float>(start), first[k].resize(start.size()), second[k].resize(start.size());
  for (int64_t step = 1; step <= 3; ++step) {
    auto grad = as<float>(uniforms(rows * size, -1, 1));
    const auto asked = std::make_unique<bool[]>(rows);
    std::vector<char> active(rows);
    for (int64_t r = 0; r < rows; ++r) active[r] = asked[r] = share == 1 || uniform(0, 1) < share;
    const bool drops = active[rows / 2] != 0;
    grad[rows / 2 * size] = std::numeric_limits<float>::quiet_NaN();
    active[rows / 2] = 0;
    for (int k = 0; k < 2; ++k) {
      const AdamRates options{float_rates.data(), share == 1 ? nullptr : asked.get(), 0.9, 0.999, 1e-8, step};
      const AdamState state{param[k].data(), grad.data(), first[k].data(), second[k].data(), rows, size};
      expect(adam_step(state, options, k == 0 ? 1 : 4) == drops, "the row with NaN is left out");
    }
    plain_adam(plain, as<double>(grad), rates, active, step);
    const auto seen = std::make_unique<bool[]>(rows);
    grad.assign(grad.size(), -0.0f);
    grad[(rows - 1) * size + size - 1] = std::numeric_limits<float>::denorm_min();
    seen_rows(grad.data(), rows, size, seen.get(), 3);
    expect(seen[rows - 1] && !seen[0], "rows with gradients are seen");
  }
  const std::string what = std::to_string(rows) + "x" + std::to_string(size);
  expect_close("Adam " + what, param[0], plain.param, 1e-6);
  expect_same_bits("Adam on 4 threads " + what, param[0], param[1]);
  expect_same_bits("first moment on 4 threads " + what, first[0], first[1]);
  expect_same_bits("second moment on 4 threads " + what, second[0], second[1]);
}

template <class S>
void test_finite() {
  auto x = as<S>(uniforms(70001, -1, 1));
  expect(count_nonfinite(x.data(), 70001, 3) == 0, "all finite");
  x[0] = std::numeric_limits<S>::infinity(), x[70000] = std::numeric_limits<S>::quiet_NaN();
  x[33333] = std::numeric_limits<S>::max();
  expect(count_nonfinite(x.data(), 70001, 3) == 2, "an infinity and a NaN are counted");
}

}  // namespace

int main() {
  skip_unless_supported();
  test_loss(1, 1, 0.2, false), test_loss(13, 20, 0.2, true), test_loss(40, 31, 0, true), test_loss(20, 40, 1, false);
  test_loss(210, 300, 0.2, true);  // more than one tile each way
  for (double share : {1.0, 0.5, 0.1}) test_adam(900, 3, share), test_adam(200, 48, share), test_adam(3000, 1, share);
  test_finite<float>(), test_finite<double>();
  return report();
}
