// CUDA's kernel language as plain C++, so that the kernels of csrc/cuda run in the ordinary tests, where there is no GPU.
// Included by one source file of a program. Blocks run one after the other, in an order that can be chosen; the threads of a
// block are fibres, each with a stack of its own, that run until they wait for others: at __syncthreads, __syncwarp, shuffles and
// votes. Only one-dimensional grids and blocks, and only what the kernels use.
//
// A launch fails (throws Failure) with the kernel's name on races, accesses out of bounds, reads of what nobody wrote
// (cuda_memory.hpp), barriers that not all threads reach or that they reach at different lines, and warp operations in
// which a named lane does not take part.
#pragma once

#include <algorithm>
#include <array>
#include <bit>
#include <functional>
#include <numeric>
#include <random>
#include <stdexcept>
#include <utility>

#include "tests/cuda_memory.hpp"
#include "tests/fibres.hpp"

// NOLINTBEGIN(bugprone-reserved-identifier): these names are CUDA's
#define __global__
#define __device__
#define __forceinline__ inline
#define __launch_bounds__(...)
#define threadIdx (::dyngs::cuda::emulated::Index{static_cast<unsigned>(::dyngs::cuda::emulated::running.thread)})
#define blockIdx (::dyngs::cuda::emulated::Index{static_cast<unsigned>(::dyngs::cuda::emulated::running.block)})
#define blockDim (::dyngs::cuda::emulated::Index{static_cast<unsigned>(::dyngs::cuda::emulated::machine.threads())})
#define gridDim (::dyngs::cuda::emulated::Index{static_cast<unsigned>(::dyngs::cuda::emulated::machine.blocks())})
#define __syncthreads() ::dyngs::cuda::emulated::machine.sync_block(__LINE__, true)
#define __syncthreads_and(predicate) (::dyngs::cuda::emulated::machine.sync_block(__LINE__, (predicate)) ? 1 : 0)
#define __syncwarp() ::dyngs::cuda::emulated::machine.sync_warp(__LINE__)
#define __shfl_sync(mask, value, lane) ::dyngs::cuda::emulated::shuffle(mask, value, lane, __LINE__)
#define __shfl_xor_sync(mask, value, lanes) \
  ::dyngs::cuda::emulated::shuffle(mask, value, ::dyngs::cuda::emulated::lane() ^ (lanes), __LINE__)
#define __shfl_up_sync(mask, value, lanes) \
  ::dyngs::cuda::emulated::shuffle(mask, value, ::dyngs::cuda::emulated::lane_below(lanes), __LINE__)
#define __ballot_sync(mask, predicate) ::dyngs::cuda::emulated::machine.ballot(mask, (predicate) ? 1 : 0, __LINE__)
#define __any_sync(mask, predicate) (__ballot_sync(mask, predicate) != 0 ? 1 : 0)
#define __match_any_sync(mask, value) ::dyngs::cuda::emulated::machine.match(mask, value, __LINE__)
#define __popc(bits) std::popcount(static_cast<uint32_t>(bits))
#define __ffs(bits) ((bits) == 0 ? 0 : std::countr_zero(static_cast<uint32_t>(bits)) + 1)
#define __clz(bits) std::countl_zero(static_cast<uint32_t>(bits))
#define DYNGS_SHARED(T, name, count) \
  static char name##_tag;            \
  const auto name = ::dyngs::cuda::emulated::machine.shared<T>(&name##_tag, #name, count)
#define DYNGS_DYNAMIC_SHARED(T, name) const auto name = ::dyngs::cuda::emulated::machine.dynamic_shared<T>(#name)
// NOLINTEND(bugprone-reserved-identifier)

namespace dyngs::cuda::emulated {

struct Failure : std::runtime_error {
  using std::runtime_error::runtime_error;
};

struct Index {
  unsigned x;
};

// In which order blocks run, and the threads of a block that can go on.
struct Schedule {
  enum class Order { kForward, kReversed, kShuffled };
  Order order = Order::kForward;
  unsigned seed = 0;
};

// The launch configuration of a kernel.
struct Grid {
  int64_t blocks;
  int threads;
  int64_t shared_bytes;
};

// Runs one launch at a time.
class Machine {
 public:
  Schedule schedule;
  int64_t launches = 0, host_reads = 0;

  int threads() const { return grid_.threads; }
  int64_t blocks() const { return grid_.blocks; }

  void run(const char* kernel, const Grid& grid, const std::function<void()>& body) {
    if (grid.blocks <= 0) return;
    if (grid.threads < 1 || grid.threads > kMostThreads || grid.blocks > INT32_MAX || grid.shared_bytes > kStaticShared)
      throw Failure(std::string(kernel) + ": a launch that no GPU takes");
    grid_ = grid, body_ = &body;
    shared_.clear(), used_shared_ = 0;
    running.kernel = kernel, running.launch += 1, ++launches;
    generator_.seed(schedule.seed);
    std::vector<int64_t> order(grid.blocks);
    std::iota(order.begin(), order.end(), 0);
    arrange(order);
    for (const int64_t block : order) run_block(block);
  }

  // Of all threads of the block; whether the predicate holds for all.
  bool sync_block(int line, bool predicate) {
    if (at_barrier_ == 0) barrier_line_ = line, barrier_all_ = true;
    if (line != barrier_line_)
      fail("threads of a block wait at __syncthreads of lines " + std::to_string(barrier_line_) + " and " +
           std::to_string(line));
    barrier_all_ &= predicate;
    if (++at_barrier_ < grid_.threads) {
      waiting_.push_back(running.thread);
      go_on_with_others();
    } else {
      at_barrier_ = 0, barrier_result_ = barrier_all_;
      ++running.block_interval;
      release(waiting_);
    }
    return barrier_result_;  // the next barrier cannot end before all have left this one
  }

  void sync_warp(int line) { collect(~0u, 0, Operation::kSync, line); }
  uint32_t ballot(uint32_t mask, uint64_t predicate, int line) {
    return static_cast<uint32_t>(collect(mask, predicate, Operation::kBallot, line));
  }
  uint32_t match(uint32_t mask, uint64_t value, int line) {
    return static_cast<uint32_t>(collect(mask, value, Operation::kMatch, line));
  }
  uint64_t shuffle(uint32_t mask, uint64_t value, int source, int line) {
    sources_[running.thread] = source;
    return collect(mask, value, Operation::kShuffle, line);
  }

  template <class T>
  Array<T> shared(const void* tag, const char* name, int64_t count) {
    for (SharedArray& array : shared_)
      if (array.tag == tag) return enter(array), Array<T>(array.region.get(), 0);
    used_shared_ += count * int64_t{sizeof(T)};
    if (used_shared_ + grid_.shared_bytes > kStaticShared) fail("more than 48 KiB of shared memory");
    return Array<T>(add_shared(tag, name, count * int64_t{sizeof(T)}, sizeof(T)), 0);
  }
  template <class T>
  Array<T> dynamic_shared(const char* name) {
    return shared_bytes<T>(name);
  }

 private:
  static constexpr int kMostThreads = 1024;
  static constexpr int64_t kStaticShared = 48 << 10;  // what every GPU grants without being asked for more
  enum class Operation { kSync, kBallot, kMatch, kShuffle };

  // An operation for which lanes of a warp wait; kept under the lowest lane of its mask.
  struct Collective {
    uint32_t mask = 0, arrived = 0;
    Operation operation = Operation::kSync;
    int line = 0;
    std::vector<int> waiting;
  };
  struct SharedArray {
    const void* tag;
    std::unique_ptr<double[]> memory;
    std::unique_ptr<Region> region;
    int64_t block;
  };

  template <class T>
  Array<T> shared_bytes(const char* name) {
    for (SharedArray& array : shared_)
      if (array.tag == &grid_) return enter(array), Array<T>(array.region.get(), 0);
    return Array<T>(add_shared(&grid_, name, grid_.shared_bytes, sizeof(T)), 0);
  }
  Region* add_shared(const void* tag, const char* name, int64_t bytes, int64_t element) {
    auto memory = std::make_unique<double[]>(bytes / 8 + 2);
    const uintptr_t odd = reinterpret_cast<uintptr_t>(memory.get()) % 16;  // aligned to 16 bytes as on a GPU
    char* begin = reinterpret_cast<char*>(memory.get()) + odd;
    auto region = std::make_unique<Region>(std::string("shared ") + name, begin, bytes, element, false, true);
    shared_.push_back({tag, std::move(memory), std::move(region), running.block});
    return shared_.back().region.get();
  }
  // Values written by another block are undefined in this one.
  void enter(SharedArray& array) {
    if (std::exchange(array.block, running.block) != running.block) array.region->forget_values();
  }

  void arrange(auto& order) {
    if (schedule.order == Schedule::Order::kReversed) std::reverse(order.begin(), order.end());
    if (schedule.order == Schedule::Order::kShuffled) std::shuffle(order.begin(), order.end(), generator_);
  }

  void run_block(int64_t block) {
    running.block = block, running.block_interval = 0;
    std::fill(std::begin(running.warp_intervals), std::end(running.warp_intervals), 0);
    at_barrier_ = 0, done_ = 0, first_ready_ = 0, failure_.clear(), waiting_.clear(), ready_.clear();
    for (Collective& c : collectives_) c.arrived = 0, c.waiting.clear();
    std::vector<int> all(grid_.threads);
    std::iota(all.begin(), all.end(), 0);
    fibres_.prepare(grid_.threads, [] { machine_main(); });
    release(all);
    running.thread = next_ready();
    fibres_.enter(running.thread);
    if (!failure_.empty()) throw Failure(failure_);
  }

  static void machine_main();
  void thread_main() {
    try {
      (*body_)();
      ++done_;
      go_on_with_others();
    } catch (const Failure& failure) {  // no exception may leave the stack that it arose on
      failure_ = failure.what();
    }
    fibres_.leave(running.thread);
  }

  // Makes threads ready to go on, and empties the list.
  void release(std::vector<int>& threads) {
    arrange(threads);
    ready_.insert(ready_.end(), threads.begin(), threads.end());
    threads.clear();
  }
  int next_ready() {
    if (schedule.order == Schedule::Order::kShuffled)
      std::swap(ready_[first_ready_], ready_[first_ready_ + generator_() % (ready_.size() - first_ready_)]);
    const int next = ready_[first_ready_++];
    if (first_ready_ == ready_.size()) ready_.clear(), first_ready_ = 0;
    return next;
  }
  // Comes back when the running thread has been released, unless it is done.
  void go_on_with_others() {
    const int me = running.thread;
    if (!ready_.empty()) {
      running.thread = next_ready();
      fibres_.transfer(me, running.thread);
      running.thread = me;
    } else if (done_ == grid_.threads) {
      fibres_.leave(me);
    } else {
      throw Failure(stuck());
    }
  }
  std::string stuck() const {
    std::string what = std::string(running.kernel) + ", block " + std::to_string(running.block) + ": deadlock, ";
    if (at_barrier_ > 0)
      what += std::to_string(at_barrier_) + " of " + std::to_string(grid_.threads) +
              " threads wait at __syncthreads of line " + std::to_string(barrier_line_);
    for (const Collective& c : collectives_)
      if (c.arrived != 0)
        return what + " lanes wait at a warp operation of line " + std::to_string(c.line) +
               " for lanes that do not come";
    return what;
  }

  uint64_t collect(uint32_t mask, uint64_t value, Operation operation, int line) {
    const int lane = running.thread % kWarp, warp = running.thread / kWarp;
    const int live = std::min(kWarp, grid_.threads - warp * kWarp);
    if (live < kWarp) fail("a warp operation in a warp of fewer than 32 threads");
    if ((mask >> lane & 1) == 0) fail("a warp operation whose mask lacks the calling lane");
    Collective& c = collectives_[warp * kWarp + std::countr_zero(mask)];
    if (c.arrived == 0) c.mask = mask, c.operation = operation, c.line = line;
    if (c.mask != mask || c.operation != operation || c.line != line)
      fail("lanes of a warp meet in different operations, lines " + std::to_string(c.line) + " and " +
           std::to_string(line));
    values_[running.thread] = value;
    c.arrived |= 1u << lane;
    if (c.arrived != mask) {
      c.waiting.push_back(running.thread);
      go_on_with_others();
    } else {
      finish(c, warp * kWarp);
    }
    return results_[running.thread];
  }

  void finish(Collective& c, int first) {
    uint32_t votes = 0;
    for (int i = 0; i < kWarp; ++i)
      if (c.mask >> i & 1) votes |= (values_[first + i] != 0 ? 1u : 0u) << i;
    for (int i = 0; i < kWarp; ++i) {
      if ((c.mask >> i & 1) == 0) continue;
      const int me = first + i;
      if (c.operation == Operation::kBallot) results_[me] = votes;
      if (c.operation == Operation::kMatch) {
        results_[me] = 0;
        for (int k = 0; k < kWarp; ++k)
          if ((c.mask >> k & 1) && values_[first + k] == values_[me]) results_[me] |= uint64_t{1} << k;
      }
      if (c.operation == Operation::kShuffle) {
        if (sources_[me] < 0 || sources_[me] >= kWarp || (c.mask >> sources_[me] & 1) == 0)
          fail("a shuffle from lane " + std::to_string(sources_[me]) + ", which does not take part");
        results_[me] = values_[first + sources_[me]];
      }
    }
    if (c.operation == Operation::kSync) ++running.warp_intervals[first / kWarp];
    c.arrived = 0;
    release(c.waiting);
  }

  Grid grid_{};
  const std::function<void()>* body_ = nullptr;
  Fibres fibres_;
  std::mt19937 generator_;
  std::vector<int> ready_, waiting_;
  size_t first_ready_ = 0;
  int at_barrier_ = 0, barrier_line_ = 0, done_ = 0;
  bool barrier_all_ = true, barrier_result_ = true;
  std::array<Collective, kMostThreads> collectives_;
  std::array<uint64_t, kMostThreads> values_{}, results_{};
  std::array<int, kMostThreads> sources_{};
  std::vector<SharedArray> shared_;
  int64_t used_shared_ = 0;
  std::string failure_;
};
inline Machine machine;

inline void Machine::machine_main() { machine.thread_main(); }

inline void fail(const std::string& what) {
  throw Failure(std::string(running.kernel) + ", block " + std::to_string(running.block) + ", thread " +
                std::to_string(running.thread) + ": " + what);
}

inline int lane() { return running.thread % kWarp; }
inline int lane_below(int lanes) { return lane() < lanes ? lane() : lane() - lanes; }  // as CUDA: one's own at the edge

template <class T>
T shuffle(uint32_t mask, T value, int source, int line) {
  static_assert(sizeof(T) <= 8);
  uint64_t bits = 0;
  std::memcpy(&bits, &value, sizeof value);
  bits = machine.shuffle(mask, bits, source, line);
  std::memcpy(&value, &bits, sizeof value);
  return value;
}

}  // namespace dyngs::cuda::emulated
