// Python bindings of the training kernels: loss, Adam, memory behaviour. Argument unpacking only.
#include "bind/arrays.hpp"
#include "bind/results.hpp"
#include "core/api.hpp"

#include <nanobind/stl/vector.h>

#include <utility>
#include <vector>

#if defined(__GLIBC__)
#include <malloc.h>
#endif

namespace dyngs {
namespace {

void l1_ssim_arrays(Array<const float, nb::shape<-1, -1, 3>> rendered, Array<const float, nb::shape<-1, -1, 3>> target,
                    std::optional<Array<const float, nb::ndim<2>>> mask,
                    std::optional<Array<float, nb::shape<-1, -1, 3>>> gradient, Array<double, nb::shape<1>> loss,
                    float ssim_weight, int threads) {
  const size_t height = rendered.shape(0), width = rendered.shape(1);
  const auto differs = [=](const auto& array) { return array.shape(0) != height || array.shape(1) != width; };
  if (differs(target) || (mask && differs(*mask)) || (gradient && differs(*gradient)))
    throw nb::value_error("l1_ssim: arrays of different sizes");
  const LossInput input{rendered.data(),
                        target.data(),
                        mask ? mask->data() : nullptr,
                        static_cast<int64_t>(height),
                        static_cast<int64_t>(width),
                        ssim_weight};
  float* to = gradient ? gradient->data() : nullptr;
  nb::gil_scoped_release release;
  write_l1_ssim(input, loss.data(), to, threads);
}

using AdamOptions = std::tuple<double, double, double, int64_t>;  // beta1, beta2, eps, step
// param, grad, exp_avg, exp_avg_sq of any shape, column_rates (C,), rows (size / C,) or None.
using AdamArrays = std::tuple<Array<float>, Array<const float>, Array<float>, Array<float>,
                              Array<const float, nb::ndim<1>>, std::optional<Array<const bool, nb::ndim<1>>>>;

AdamState adam_state(const AdamArrays& arrays) {
  const auto& [param, grad, exp_avg, exp_avg_sq, column_rates, rows] = arrays;
  const size_t size = param.size(), row_size = column_rates.shape(0), num_rows = row_size ? size / row_size : 0;
  const auto differs = [=](const auto& array) { return array.size() != size; };
  if (differs(grad) || differs(exp_avg) || differs(exp_avg_sq) || num_rows * row_size != size ||
      (rows && rows->shape(0) != num_rows))
    throw nb::value_error("adam_steps: arrays of different sizes");
  return {param.data(),
          grad.data(),
          exp_avg.data(),
          exp_avg_sq.data(),
          static_cast<int64_t>(num_rows),
          static_cast<int64_t>(row_size)};
}

void adam_steps_arrays(const std::vector<AdamArrays>& all, Array<int32_t, nb::shape<1>> skipped,
                       const AdamOptions& options, int threads) {
  const auto [beta1, beta2, eps, step] = options;
  std::vector<std::pair<AdamState, AdamRates>> updates;
  for (const AdamArrays& one : all) {
    const auto& rows = std::get<5>(one);
    updates.push_back(
        {adam_state(one), {std::get<4>(one).data(), rows ? rows->data() : nullptr, beta1, beta2, eps, step}});
  }
  nb::gil_scoped_release release;
  for (const auto& [state, rates] : updates) write_adam_step(state, rates, skipped.data(), threads);
}

void seen_rows_arrays(Array<const float, nb::ndim<2>> grads, Array<bool, nb::ndim<1>> seen, int threads) {
  if (grads.shape(0) != seen.shape(0)) throw nb::value_error("seen_rows: arrays of different sizes");
  const float* from = grads.data();
  bool* to = seen.data();
  const int64_t num_rows = grads.shape(0), row_size = grads.shape(1);
  nb::gil_scoped_release release;
  seen_rows(from, num_rows, row_size, to, threads);
}

// Returns whether the allocator took the settings. No mapped blocks at all, because M_MMAP_THRESHOLD has a documented limit
// of 32 MiB.
bool keep_freed_memory() {
#if defined(__GLIBC__)
  constexpr int kNever = -1;
  return mallopt(M_MMAP_MAX, 0) == 1 && mallopt(M_TRIM_THRESHOLD, kNever) == 1;
#else
  return false;
#endif
}

}  // namespace

void bind_train(nb::module_& module) {
  module.def("l1_ssim", l1_ssim_arrays, array("rendered"), array("target"), array("mask").none(),
             array("gradient").none(), array("loss"), nb::arg("ssim_weight"), nb::arg("num_threads"),
             "Writes the loss of two (H, W, 3) images, and its gradient by `rendered` unless that is None.");
  module.def("adam_steps", adam_steps_arrays, array("updates"), array("skipped"), nb::arg("options"),
             nb::arg("num_threads"),
             "Adam step of several arrays in place; adds the number of rows skipped for a non-finite gradient.");
  module.def("seen_rows", seen_rows_arrays, array("grads"), array("seen"), nb::arg("num_threads"),
             "Writes which rows of (N, C) gradients have an element other than zero.");
  module.def("keep_freed_memory", keep_freed_memory,
             "Lets the allocator reuse freed blocks of any size instead of returning them to the system.");
}

}  // namespace dyngs
