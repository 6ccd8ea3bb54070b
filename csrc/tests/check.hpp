// Shared by the C++ tests: random inputs that are the same on every machine, comparisons that print what failed, and
// slopes by central differences.
#pragma once

#include <algorithm>
#include <cmath>
#include <cstdio>
#include <cstdlib>
#include <cstring>
#include <functional>
#include <random>
#include <string>
#include <vector>

#include "core/isa.hpp"

namespace check {

using Values = std::vector<double>;

inline int failures = 0;
// Not a global: nothing may run before skip_unless_supported().
inline std::mt19937_64& generator() {
  static std::mt19937_64 state(7);
  return state;
}

inline double uniform(double lo, double hi) { return std::uniform_real_distribution<double>(lo, hi)(generator()); }

// Rounded to float, so that the float and the double kernels are given the same numbers.
inline Values uniforms(int64_t n, double lo, double hi) {
  Values v(n);
  for (double& x : v) x = static_cast<float>(uniform(lo, hi));
  return v;
}

template <class S, class T>
std::vector<S> as(const std::vector<T>& v) {
  std::vector<S> to(v.size());
  for (size_t i = 0; i < v.size(); ++i) to[i] = static_cast<S>(v[i]);
  return to;
}

inline void expect(bool holds, const std::string& what) {
  if (holds) return;
  std::printf("FAILED %s\n", what.c_str());
  ++failures;
}

// The largest difference is at most `tolerance` times the largest magnitude wanted; false for NaN.
template <class A, class B>
void expect_close(const std::string& what, const std::vector<A>& got, const std::vector<B>& wanted, double tolerance) {
  double error = 0, largest = 0;
  for (size_t i = 0; i < got.size(); ++i) {
    const double difference = std::abs(static_cast<double>(got[i]) - static_cast<double>(wanted[i]));
    if (!std::isnan(error) && !(difference <= error)) error = difference;  // NaN stays
    largest = std::max(largest, std::abs(static_cast<double>(wanted[i])));
  }
  if (got.size() == wanted.size() && largest > 0 && error <= tolerance * largest) return;
  std::printf("FAILED %s: largest error %.3g, largest value %.3g, tolerance %.1g\n", what.c_str(), error, largest,
              tolerance);
  ++failures;
}

template <class T>
void expect_same_bits(const std::string& what, const std::vector<T>& a, const std::vector<T>& b) {
  expect(a.size() == b.size() && (a.empty() || std::memcmp(a.data(), b.data(), a.size() * sizeof(T)) == 0), what);
}

// `gradient` is that of `scalar` at x: `count` entries of it, spread over the array, against central differences with
// steps of `h`, to `tolerance` of the largest gradient.
inline void expect_gradient(const std::string& what, const std::function<double(const Values&)>& scalar,
                            const Values& x, const Values& gradient, double h, double tolerance, int64_t count = 12) {
  const int64_t n = static_cast<int64_t>(x.size());
  Values got, slopes;
  for (int64_t k = 0; k < std::min(n, count); ++k) {
    const int64_t i = n <= count ? k : (k * n) / count + (k * 7) % (n / count);
    Values up = x, down = x;
    up[i] += h, down[i] -= h;
    got.push_back(gradient[i]);
    slopes.push_back((scalar(up) - scalar(down)) / (2 * h));
  }
  expect_close(what, got, slopes, tolerance);
}

inline double dot(const Values& a, const Values& b) {
  double sum = 0;
  for (size_t i = 0; i < a.size(); ++i) sum += a[i] * b[i];
  return sum;
}

using Function = std::function<Values(const Values&)>;

inline void expect_near(const std::string& what, double got, double wanted, double tolerance) {
  if (std::abs(got - wanted) <= tolerance * std::max(1.0, std::abs(wanted))) return;  // false for NaN
  std::printf("FAILED %s: got %.17g, expected %.17g\n", what.c_str(), got, wanted);
  ++failures;
}

// `gradient` must be the gradient of <cotangent, f(x)>.
inline void expect_vjp(const std::string& what, const Function& f, const Values& x, const Values& cotangent,
                       const Values& gradient) {
  const auto scalar = [&](const Values& at) {
    const Values y = f(at);
    double sum = 0;
    for (size_t i = 0; i < y.size(); ++i) sum += cotangent[i] * y[i];
    return sum;
  };
  for (size_t i = 0; i < x.size(); ++i) {
    const double h = 1e-4;
    Values far = x, near = x, farther = x, nearer = x;
    far[i] += h, near[i] -= h, farther[i] += 2 * h, nearer[i] -= 2 * h;
    // fourth order: truncation 1e-16 / 30 times the fifth derivative, rounding 1e-16 / 1e-4 times the value (1e3 px)
    const double slope = (8 * (scalar(far) - scalar(near)) - (scalar(farther) - scalar(nearer))) / (12 * h);
    expect_near(what + ", input " + std::to_string(i), gradient[i], slope, 1e-7);
  }
}

// Ends the program with the code that CTest knows for "skipped" where the processor lacks what it was compiled for.
inline void skip_unless_supported() {
#if defined(DYNGS_NEEDS)
  if (std::strcmp(dyngs::best_isa(), DYNGS_NEEDS) >= 0) return;
  std::printf("skipped: this processor lacks the instructions\n");
  std::exit(77);
#endif
}

inline int report() {
  std::printf(failures == 0 ? "all passed\n" : "%d checks failed\n", failures);
  return failures == 0 ? 0 : 1;
}

}  // namespace check
