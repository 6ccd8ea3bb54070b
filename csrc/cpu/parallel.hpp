// Three ways to share a loop among OpenMP threads. Results never depend on the number of threads as long as the bodies
// write disjoint places. An exception that left a parallel region would end the process: the first one is kept, the
// rest of the loop is skipped, and it is thrown again after the region.
#pragma once

#include <omp.h>

#include <algorithm>
#include <atomic>
#include <cstdint>
#include <exception>
#include <memory>
#include <vector>

namespace dyngs {

// The first exception among threads.
class FirstException {
 public:
  template <class F>
  void watch(F&& f) noexcept {
    if (thrown_.load(std::memory_order_relaxed)) return;
    try {
      f();
    } catch (...) {
      if (!thrown_.exchange(true)) first_ = std::current_exception();
    }
  }
  // To be called after the region, when all threads are done.
  void rethrow() const {
    if (first_) std::rethrow_exception(first_);
  }

 private:
  std::atomic<bool> thrown_{false};
  std::exception_ptr first_;
};

// One T(args...) for each worker of parallel_workers: its own scratch memory, allocated before the loop.
template <class T, class... Args>
std::vector<std::unique_ptr<T>> for_each_worker(int threads, const Args&... args) {
  std::vector<std::unique_ptr<T>> all(std::max(threads, 1));
  for (auto& one : all) one = std::make_unique<T>(args...);
  return all;
}

// f(worker, begin, end) over [0, n) in pieces of `grain`, handed out dynamically; no two run at once for one worker.
template <class F>
void parallel_workers(int64_t n, int64_t grain, int threads, F&& f) {
  const int64_t pieces = (n + grain - 1) / grain;
  if (threads <= 1 || pieces <= 1) {
    for (int64_t i = 0; i < pieces; ++i) f(0, i * grain, std::min(n, (i + 1) * grain));
    return;
  }
  FirstException exception;
#pragma omp parallel for schedule(dynamic, 1) num_threads(threads)
  for (int64_t i = 0; i < pieces; ++i)
    exception.watch([&] { f(omp_get_thread_num(), i * grain, std::min(n, (i + 1) * grain)); });
  exception.rethrow();
}

// The same with f(begin, end).
template <class F>
void parallel_for(int64_t n, int64_t grain, int threads, F&& f) {
  parallel_workers(n, grain, threads, [&](int, int64_t begin, int64_t end) { f(begin, end); });
}

// f(part, begin, end) for `parts` equal contiguous ranges of [0, n), one per thread.
template <class F>
void parallel_parts(int64_t n, int parts, F&& f) {
  if (parts <= 1) {
    for (int i = 0; i < parts; ++i) f(i, n * i / parts, n * (i + 1) / parts);
    return;
  }
  FirstException exception;
#pragma omp parallel for schedule(static, 1) num_threads(parts)
  for (int i = 0; i < parts; ++i) exception.watch([&] { f(i, n * i / parts, n * (i + 1) / parts); });
  exception.rethrow();
}

}  // namespace dyngs
