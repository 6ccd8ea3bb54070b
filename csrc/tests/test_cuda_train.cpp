// The CUDA kernels of the loss and of the optimiser, run by the emulation of cuda_on_cpu.hpp with all its checks, or on a GPU
// (tests/GPU.hpp): against the CPU's, and bit by bit against themselves under other orders of blocks and threads.
#include <limits>

#include "tests/check.hpp"
#include "tests/gpu.hpp"

namespace {

using namespace dyngs;
using namespace check;

// A image, its target and a mask, or none.
struct Images {
  int64_t height, width;
  std::vector<float> rendered, target, mask;
};

Images random_images(int64_t height, int64_t width, bool masked, double brightness = 0.5, double spread = 0.5) {
  const double lo = brightness - spread, hi = brightness + spread;
  Images p{height,
           width,
           as<float>(uniforms(3 * height * width, lo, hi)),
           as<float>(uniforms(3 * height * width, lo, hi)),
           {}};
  if (masked) p.mask = as<float>(uniforms(height * width, 0, 1));
  return p;
}

struct Loss {
  double value;
  std::vector<float> gradient;
};

Loss loss_on_cpu(const Images& p, float ssim_weight) {
  Loss loss{0, std::vector<float>(p.rendered.size())};
  loss.value = l1_ssim_loss(
      {p.rendered.data(), p.target.data(), p.mask.empty() ? nullptr : p.mask.data(), p.height, p.width, ssim_weight},
      loss.gradient.data(), 1);
  return loss;
}

Loss loss_on_gpu(const Images& p, float ssim_weight, bool with_gradient = true) {
  Memory<float> rendered(p.rendered, "rendered"), target(p.target, "target"), mask(p.mask, "mask");
  Memory<float> gradient(static_cast<int64_t>(p.rendered.size()), "gradient");
  Memory<double> value(1, "loss");
  Memory<char> workspace(cuda::l1_ssim_loss_workspace(p.height, p.width), "workspace");
  cuda::l1_ssim_loss(
      {rendered.get(), target.get(), p.mask.empty() ? nullptr : mask.get(), p.height, p.width, ssim_weight},
      value.get(), with_gradient ? gradient.get() : nullptr, {workspace.get(), workspace.count()}, nullptr);
  return {value.values()[0], gradient.values()};
}

void test_loss(const std::string& name, const Images& p, float ssim_weight) {
  const std::string what = name + " " + std::to_string(p.width) + "x" + std::to_string(p.height);
  const Loss gpu = loss_on_gpu(p, ssim_weight), cpu = loss_on_cpu(p, ssim_weight);
  expect_close("loss, " + what, Values{gpu.value}, Values{cpu.value}, 2e-6);
  expect_close("gradient of the loss, " + what, gpu.gradient, cpu.gradient, 2e-5);
  expect(loss_on_gpu(p, ssim_weight, false).value == gpu.value, "the loss without its gradient, " + what);
  in_other_orders([&] {
    const Loss again = loss_on_gpu(p, ssim_weight);
    expect(again.value == gpu.value, "the loss in another order, " + what);
    expect_same_bits("gradient in another order, " + what, again.gradient, gpu.gradient);
  });
}

// Images that float32 cannot square: the tiles concerned, and those beside them, are computed in double.
void test_bright_images() {
  test_loss("1000 +- 0.1", random_images(20, 35, true, 1000, 0.1), 0.2f);
  Images spot = random_images(40, 50, false);
  spot.rendered[3 * (17 * 50 + 15) + 1] = 1e30f;
  test_loss("one pixel of 1e30", spot, 0.2f);
  Images spots = random_images(40, 50, false);  // the gradient reaches tiles that are themselves precise in float32
  spots.rendered[3 * (8 * 50 + 8)] = spots.rendered[3 * (24 * 50 + 40) + 2] = 1e30f;
  test_loss("two pixels of 1e30", spots, 0.2f);
  Images beside = random_images(33, 49, false);  // the bright pixel's window reaches four tiles
  beside.rendered[3 * (15 * 49 + 16)] = 300;
  test_loss("one pixel of 300", beside, 0.5f);
}

void test_empty_mask() {
  Images p = random_images(18, 20, true);
  std::fill(p.mask.begin(), p.mask.end(), 0.f);
  const Loss loss = loss_on_gpu(p, 0.2f);
  expect(loss.value == 0, "a mask without weight costs nothing");
  expect(std::all_of(loss.gradient.begin(), loss.gradient.end(), [](float x) { return x == 0; }),
         "a mask without weight has no gradient");
}

// The state of Adam after three steps, and how many rows were left out in each.
struct Trained {
  std::vector<float> param, first, second;
  std::vector<int64_t> skipped;
};

struct AdamCase {
  int64_t rows, size;
  std::vector<float> start, rates;
  std::vector<std::vector<float>> grads;
  std::vector<char> asked;  // empty: all
};

AdamCase adam_case(int64_t rows, int64_t size, double share) {
  AdamCase c{rows, size, as<float>(uniforms(rows * size, -1, 1)), as<float>(uniforms(size, 1e-3, 1e-2)), {}, {}};
  for (int step = 0; step < 3; ++step) c.grads.push_back(as<float>(uniforms(rows * size, -1, 1)));
  c.grads[1][rows / 2 * size] = std::numeric_limits<float>::quiet_NaN();
  c.grads[2][size - 1] = 1e19f, c.grads[0][size - 1] = 9e18f;  // 2^63 lies between them
  c.grads[2][(rows - 1) * size] = -std::numeric_limits<float>::infinity();
  for (int64_t r = 0; share < 1 && r < rows; ++r) c.asked.push_back(uniform(0, 1) < share ? 1 : 0);
  return c;
}

Trained adam_on_cpu(const AdamCase& c) {
  Trained t{c.start, std::vector<float>(c.start.size()), std::vector<float>(c.start.size()), {}};
  const auto asked = std::make_unique<bool[]>(c.rows);
  for (size_t r = 0; r < c.asked.size(); ++r) asked[r] = c.asked[r] != 0;
  for (int64_t step = 1; step <= 3; ++step)
    t.skipped.push_back(
        adam_step({t.param.data(), c.grads[step - 1].data(), t.first.data(), t.second.data(), c.rows, c.size},
                  {c.rates.data(), c.asked.empty() ? nullptr : asked.get(), 0.9, 0.999, 1e-8, step}, 1));
  return t;
}

Trained adam_on_gpu(const AdamCase& c) {
  const std::vector<float> zeros(c.start.size());
  Memory<float> param(c.start, "param"), first(zeros, "exp_avg"), second(zeros, "exp_avg_sq"), rates(c.rates, "rates");
  Memory<bool> asked(std::vector<bool>(c.asked.begin(), c.asked.end()), "rows");
  std::vector<int64_t> skipped;
  for (int64_t step = 1; step <= 3; ++step) {
    Memory<float> grad(c.grads[step - 1], "grad");
    Memory<int32_t> count(std::vector<int32_t>{0}, "skipped");
    cuda::adam_step({param.get(), grad.get(), first.get(), second.get(), c.rows, c.size},
                    {rates.get(), c.asked.empty() ? nullptr : asked.get(), 0.9, 0.999, 1e-8, step}, count.get(),
                    nullptr);
    skipped.push_back(count.values()[0]);
  }
  return {param.values(), first.values(), second.values(), skipped};
}

void test_adam(int64_t rows, int64_t size, double share) {
  const std::string what = std::to_string(rows) + "x" + std::to_string(size) + ", share " + std::to_string(share);
  const AdamCase c = adam_case(rows, size, share);
  const Trained gpu = adam_on_gpu(c), cpu = adam_on_cpu(c);
  expect_close("Adam " + what, gpu.param, cpu.param, 1e-6);
  expect_close("first moment " + what, gpu.first, cpu.first, 1e-6);
  expect_close("second moment " + what, gpu.second, cpu.second, 1e-6);
  expect(gpu.skipped == cpu.skipped, "rows left out " + what);
  in_other_orders([&] {
    const Trained again = adam_on_gpu(c);
    expect_same_bits("Adam in another order " + what, again.param, gpu.param);
    expect(again.skipped == gpu.skipped, "rows left out in another order " + what);
  });
}

void test_seen_rows() {
  std::vector<float> grads(5 * 7, -0.f);
  grads[2 * 7 + 6] = std::numeric_limits<float>::denorm_min(), grads[4 * 7] = std::numeric_limits<float>::quiet_NaN();
  Memory<float> in(grads, "grads");
  Memory<bool> seen(5, "seen");
  cuda::seen_rows(in.get(), 5, 7, seen.get(), nullptr);
  expect(seen.values() == std::vector<bool>{false, false, true, false, true}, "rows with gradients are seen");
}

void test_finite() {
  auto x = as<float>(uniforms(70001, -1, 1));
  const auto count = [&x] {
    Memory<float> in(x, "x");
    Memory<int32_t> total(std::vector<int32_t>{0}, "count");
    cuda::count_nonfinite(in.get(), in.count(), total.get(), nullptr);
    return total.values()[0];
  };
  expect(count() == 0, "all finite");
  x[0] = std::numeric_limits<float>::infinity(), x[70000] = std::numeric_limits<float>::quiet_NaN();
  x[33333] = std::numeric_limits<float>::max();
  expect(count() == 2, "an infinity and a NaN are counted");
}

}  // namespace

int main() {
  skip_without_gpu();
  for (const float ssim_weight : {0.f, 0.2f, 1.f}) {
    test_loss("plain", random_images(1, 1, false), ssim_weight);
    test_loss("plain", random_images(20, 40, false), ssim_weight);
    test_loss("masked", random_images(33, 19, true), ssim_weight);
  }
  test_loss("many tiles", random_images(260, 271, true), 0);
  test_bright_images();
  test_empty_mask();
  for (const double share : {1.0, 0.5, 0.1})
    test_adam(700, 3, share), test_adam(60, 48, share), test_adam(2500, 1, share);
  test_adam(3, 1500, 1);  // rows longer than a block's share
  test_seen_rows();
  test_finite();
  return report();
}
