#include "cpu/memory.hpp"

#include <algorithm>
#include <cstdio>
#include <fstream>
#include <limits>
#include <sstream>
#if defined(__linux__)
#include <sys/resource.h>
#include <unistd.h>
#endif

namespace dyngs {
namespace {

constexpr int64_t kUnlimited = std::numeric_limits<int64_t>::max();

#if defined(__linux__)

// The number after `name` in a file of names and numbers, or of one number if `name` is empty; `otherwise` if there is
// none, as where a limit is "max".
int64_t number_in(const std::string& path, const std::string& name, int64_t otherwise) {
  std::ifstream file(path);
  for (std::string line; std::getline(file, line);) {
    if (line.compare(0, name.size(), name) != 0) continue;
    std::istringstream rest(line.substr(name.size()));
    int64_t value;
    return rest >> value ? value : otherwise;  // also where it is too large for 64 bits
  }
  return otherwise;
}

int64_t left_on_machine(const std::string& root) {
  const int64_t kilobytes = number_in(root + "/proc/meminfo", "MemAvailable:", -1);
  return kilobytes < 0 ? kUnlimited : 1024 * kilobytes;
}

// Names of a control group's files: its limit, its usage, and the part of the usage that is file cache and can be dropped.
struct GroupFiles {
  const char *limit, *usage, *inactive;
};

// Bytes that a control group and its parents still allow. `path` begins with a slash.
int64_t left_in_groups(const std::string& mount, std::string path, const GroupFiles& files) {
  int64_t left = kUnlimited;
  for (;; path.resize(path.rfind('/'))) {
    const std::string folder = mount + path + "/";
    const int64_t limit = number_in(folder + files.limit, "", kUnlimited);
    if (limit != kUnlimited) {
      const int64_t used = number_in(folder + files.usage, "", 0);
      left = std::min(left, limit - used + number_in(folder + "memory.stat", files.inactive, 0));
    }
    if (path.empty()) return left;
  }
}

int64_t left_in_control_groups(const std::string& root) {
  std::ifstream file(root + "/proc/self/cgroup");
  int64_t left = kUnlimited;
  for (std::string line; std::getline(file, line);) {  // number:controllers:path
    const size_t first = line.find(':'), second = line.find(':', first + 1);
    if (second == std::string::npos || line[second + 1] != '/') continue;
    const std::string controllers = line.substr(first + 1, second - first - 1);
    std::string path = line.substr(second + 1);
    if (path == "/") path.clear();
    if (controllers.empty()) {
      left = std::min(
          left, left_in_groups(root + "/sys/fs/cgroup", path, {"memory.max", "memory.current", "inactive_file "}));
    } else if (controllers == "memory") {
      left = std::min(left, left_in_groups(root + "/sys/fs/cgroup/memory", path,
                                           {"memory.limit_in_bytes", "memory.usage_in_bytes", "total_inactive_file "}));
    }
  }
  return left;
}

int64_t left_in_address_space(const std::string& root) {
  rlimit limit;
  if (getrlimit(RLIMIT_AS, &limit) != 0 || limit.rlim_cur == RLIM_INFINITY) return kUnlimited;
  const int64_t pages = number_in(root + "/proc/self/statm", "", 0);
  return static_cast<int64_t>(std::min<uint64_t>(limit.rlim_cur, kUnlimited)) - pages * sysconf(_SC_PAGESIZE);
}

#endif

}  // namespace

int64_t available_memory(const std::string& root) {
#if defined(__linux__)
  const int64_t left = std::min({left_on_machine(root), left_in_control_groups(root), left_in_address_space(root)});
  return std::max<int64_t>(left, 0);
#else
  (void)root;
  return int64_t{16} << 30;
#endif
}

std::string gigabytes(int64_t bytes) {
  char text[32];
  std::snprintf(text, sizeof text, "%.*f GB", bytes < 100'000'000 ? 3 : 1, static_cast<double>(bytes) / 1e9);
  return text;
}

}  // namespace dyngs
