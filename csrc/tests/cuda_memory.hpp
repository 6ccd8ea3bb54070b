// Memory as the emulated kernels of cuda_on_cpu.hpp see it: every access goes through an Array, which knows the region that it
// belongs to and fails with the kernel's name where CUDA would be silent:
//   out of bounds, misaligned, read before anything was written, and races.
//
// A race: two threads touch one address, at least one of them writes, not both by atomics, and nothing orders the two.
// Threads of one block are ordered by __syncthreads, those of one warp also by __syncwarp of the whole warp (a shuffle or
// a vote orders no memory), threads of different blocks by nothing but the end of the launch. What ran first in the
// emulation does not matter: accesses are compared by the barriers between them, so a race is found on any schedule that
// reaches both.
#pragma once

#include <cstdint>
#include <cstring>
#include <map>
#include <memory>
#include <string>
#include <type_traits>
#include <vector>

namespace dyngs::cuda::emulated {

inline constexpr int kWarp = 32;

// Who runs, for messages and comparisons.
struct Running {
  const char* kernel = "no kernel";
  int64_t launch = 0, block = 0;
  int thread = 0;
  uint32_t block_interval = 0;                 // barriers that the block has passed
  uint32_t warp_intervals[1024 / kWarp] = {};  // __syncwarps that each warp has passed
};
inline Running running;

// Ends the launch with a Failure that names kernel, block and thread. Does not return.
[[noreturn]] void fail(const std::string& what);

// An access as a later one must see it.
struct Access {
  static constexpr int kNobody = -1, kSeveral = -2;
  int thread = kNobody;
  uint32_t block_interval = 0, warp_interval = 0;

  static Access of_running() {
    return {running.thread, running.block_interval, running.warp_intervals[running.thread / kWarp]};
  }
  bool same_warp() const { return thread >= 0 && thread / kWarp == running.thread / kWarp; }
  // True if a barrier or program order separates this access from the running thread.
  bool ordered() const {
    if (thread == kNobody || thread == running.thread || block_interval != running.block_interval) return true;
    return same_warp() && warp_interval != running.warp_intervals[running.thread / kWarp];
  }
};

// Accesses to one granule (four bytes, or one for smaller elements) in the running launch.
class Shadow {
 public:
  enum class Kind { kRead, kWrite, kAtomic };

  // The thread that this access races with, Access::kSeveral if there are more or it is of another block, or kNobody.
  // `own`: memory that every block has for itself.
  int note(Kind kind, bool own) {
    enter(own);
    const int other = conflict(kind);
    if (kind == Kind::kRead) {
      note_read();
    } else {
      const bool shared_atomic = kind == Kind::kAtomic && atomic_ && !writer_.ordered();
      writer_ = Access::of_running();
      if (shared_atomic) writer_.thread = Access::kSeveral;
      atomic_ = kind == Kind::kAtomic;
    }
    return other;
  }

 private:
  // Forgets the last launch, and folds what another block did into three flags.
  void enter(bool own) {
    if (launch_ == running.launch && block_ == running.block) return;
    if (launch_ != running.launch || own) {
      others_read_ = others_wrote_ = others_added_ = false;
    } else {
      others_read_ |= readers_[0].thread != Access::kNobody;
      others_wrote_ |= writer_.thread != Access::kNobody && !atomic_;
      others_added_ |= writer_.thread != Access::kNobody && atomic_;
    }
    launch_ = running.launch, block_ = running.block;
    writer_ = readers_[0] = readers_[1] = readers_[2] = Access{};
    atomic_ = false;
  }

  int conflict(Kind kind) const {
    if (others_wrote_ || (kind != Kind::kAtomic && others_added_) || (kind != Kind::kRead && others_read_))
      return Access::kSeveral;
    if (!writer_.ordered() && !(kind == Kind::kAtomic && atomic_)) return writer_.thread;
    if (kind == Kind::kRead) return Access::kNobody;
    for (const Access& reader : readers_)
      if (!reader.ordered()) return reader.thread;
    return Access::kNobody;
  }

  // Keeps the last reader, the last other one of its warp, and the last one of another warp.
  void note_read() {
    const Access now = Access::of_running();
    if (readers_[0].thread != now.thread && readers_[0].thread != Access::kNobody)
      readers_[readers_[0].same_warp() ? 1 : 2] = readers_[0];
    readers_[0] = now;
  }

  int64_t launch_ = -1, block_ = -1;
  Access writer_, readers_[3];
  bool atomic_ = false, others_read_ = false, others_wrote_ = false, others_added_ = false;
};

// A stretch of memory with bounds: an allocation, an array cut out of one, or an array of a block's shared memory.
class Region {
 public:
  // `shared`: every block has its own, and finds nothing in it.
  Region(std::string name, void* begin, int64_t bytes, int64_t element, bool known, bool shared = false)
      : name_(std::move(name)),
        begin_(static_cast<char*>(begin)),
        bytes_(bytes),
        granule_(element < 4 ? element : 4),
        shared_(shared),
        shadows_(static_cast<size_t>(bytes / granule_)),
        known_(shadows_.size(), known) {}

  char* begin() const { return begin_; }
  int64_t bytes() const { return bytes_; }
  void forget_values() { known_.assign(known_.size(), false); }

  // The address of `size` bytes at `offset`, after all checks.
  char* access(int64_t offset, int64_t size, int64_t alignment, Shadow::Kind kind) {
    if (offset < 0 || offset + size > bytes_) fail("out of bounds: " + where(offset));
    if (reinterpret_cast<uintptr_t>(begin_ + offset) % static_cast<uintptr_t>(alignment) != 0)
      fail("misaligned: " + where(offset));
    for (int64_t g = offset / granule_; g < (offset + size + granule_ - 1) / granule_; ++g) {
      if (kind != Shadow::Kind::kWrite && !known_[g]) fail("read before it was written: " + where(g * granule_));
      known_[g] = true;
      const int other = shadows_[g].note(kind, shared_);
      if (other == Access::kNobody) continue;
      fail("race: " + where(g * granule_) + " is also touched by " +
           (other >= 0 ? "thread " + std::to_string(other) : "other threads or blocks") + ", with no barrier between");
    }
    return begin_ + offset;
  }

 private:
  std::string where(int64_t offset) const {
    return name_ + ", byte " + std::to_string(offset) + " of " + std::to_string(bytes_);
  }

  std::string name_;
  char* begin_;
  int64_t bytes_, granule_;
  bool shared_;
  std::vector<Shadow> shadows_;
  std::vector<char> known_;
};

// All regions of global memory, by their first byte.
class Regions {
 public:
  Region& add(std::unique_ptr<Region> region) { return *(by_begin_[region->begin()] = std::move(region)); }
  void remove(const void* begin, int64_t bytes) {
    const char* first = static_cast<const char*>(begin);
    by_begin_.erase(by_begin_.lower_bound(first), by_begin_.lower_bound(first + (bytes > 0 ? bytes : 1)));
  }
  Region* find(const void* p) {
    auto above = by_begin_.upper_bound(static_cast<const char*>(p));
    if (above == by_begin_.begin()) return nullptr;
    Region* region = std::prev(above)->second.get();
    return p == region->begin() || p < region->begin() + region->bytes() ? region : nullptr;
  }

 private:
  std::map<const char*, std::unique_ptr<Region>> by_begin_;
};
inline Regions& regions() {
  static Regions all;
  return all;
}

}  // namespace dyngs::cuda::emulated

namespace dyngs::cuda {

template <class T>
class Array;

// One element of an Array that may be written.
template <class T>
class Element {
 public:
  Element(const Array<T>& array, int64_t index) : array_(array), index_(index) {}
  Element(const Element&) = default;
  operator T() const { return array_.read(index_); }
  const Element& operator=(const T& value) const {
    array_.write(index_, value);
    return *this;
  }
  const Element& operator=(const Element& other) const { return *this = static_cast<T>(other); }
  const Element& operator+=(const T& value) const { return *this = static_cast<T>(*this) + value; }

 private:
  const Array<T>& array_;
  int64_t index_;
};

// A checked pointer. Where nvcc compiles, it is a plain one (cuda/device.hpp).
template <class T>
class Array {
  using Value = std::remove_const_t<T>;
  using Kind = emulated::Shadow::Kind;

 public:
  Array() = default;
  Array(std::nullptr_t) {}
  Array(emulated::Region* region, int64_t offset) : region_(region), offset_(offset) {}
  template <class U>
    requires std::is_same_v<const U, T>
  Array(const Array<U>& other) : region_(other.region()), offset_(other.offset()) {}

  explicit operator bool() const { return region_ != nullptr; }
  emulated::Region* region() const { return region_; }
  int64_t offset() const { return offset_; }
  Array operator+(int64_t elements) const { return {region_, offset_ + elements * int64_t{sizeof(T)}}; }
  decltype(auto) operator[](int64_t i) const {
    if constexpr (std::is_const_v<T>) {
      return read(i);
    } else {
      return Element<T>(*this, i);
    }
  }

  Value read(int64_t i) const {
    Value value;
    std::memcpy(static_cast<void*>(&value), access(i, Kind::kRead), sizeof(T));
    return value;
  }
  void write(int64_t i, const Value& value) const {
    std::memcpy(access(i, Kind::kWrite), static_cast<const void*>(&value), sizeof(T));
  }
  // Adds, and returns what was there before.
  Value add(int64_t i, const Value& value) const {
    char* at = access(i, Kind::kAtomic);
    Value before;
    std::memcpy(&before, at, sizeof(T));
    const Value after = before + value;
    std::memcpy(at, &after, sizeof(T));
    return before;
  }

 private:
  char* access(int64_t i, Kind kind) const {
    if (region_ == nullptr) emulated::fail("a null array is used");
    return region_->access(offset_ + i * int64_t{sizeof(T)}, sizeof(T), alignof(T), kind);
  }

  emulated::Region* region_ = nullptr;
  int64_t offset_ = 0;
};

// The array at an address of global memory.
template <class T>
Array<T> global(T* p) {
  if (p == nullptr) return {};
  emulated::Region* region = emulated::regions().find(p);
  if (region == nullptr) emulated::fail("an address that is not in any allocation");
  return {region, reinterpret_cast<const char*>(p) - region->begin()};
}

template <class T>
T atomic_add(const Array<T>& array, int64_t index, std::type_identity_t<T> value) {
  return array.add(index, value);
}

namespace emulated {

// An allocation of global memory on the "device".
template <class T>
class Memory {
 public:
  // Not to be read before it is written.
  explicit Memory(int64_t count, const std::string& name = "an output") : values_(std::make_unique<T[]>(count)) {
    std::memset(static_cast<void*>(values_.get()), 0xff, count * sizeof(T));
    add(name, count, false);
  }
  explicit Memory(const std::vector<T>& values, const std::string& name = "an input")
      : values_(std::make_unique<T[]>(values.size())) {
    std::copy(values.begin(), values.end(), values_.get());
    add(name, static_cast<int64_t>(values.size()), true);
  }
  Memory(const Memory&) = delete;
  Memory& operator=(const Memory&) = delete;
  ~Memory() { regions().remove(values_.get(), count_ * int64_t{sizeof(T)}); }

  T* get() { return values_.get(); }
  int64_t count() const { return count_; }
  std::vector<T> values() const { return std::vector<T>(values_.get(), values_.get() + count_); }

 private:
  void add(const std::string& name, int64_t count, bool known) {
    count_ = count;
    regions().add(std::make_unique<Region>(name, values_.get(), count * int64_t{sizeof(T)}, sizeof(T), known));
  }
  std::unique_ptr<T[]> values_;
  int64_t count_ = 0;
};

// Makes an array that was cut out of an allocation a region of its own. Cut in the same way again, it keeps its values.
inline void split(void* begin, int64_t bytes, int64_t element) {
  const Region* before = regions().find(begin);
  if (before != nullptr && before->begin() == begin && before->bytes() == bytes) return;
  regions().add(std::make_unique<Region>("a part of a workspace", begin, bytes, element, false));
}

}  // namespace emulated
}  // namespace dyngs::cuda
