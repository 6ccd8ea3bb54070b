// The amount of free memory.
#pragma once

#include <cstdint>
#include <string>

namespace dyngs {

// Bytes that this process can still allocate: the least of the limits of the machine, the control groups and RLIMIT_AS.
// Takes about 0.1 ms. 16 GiB on other systems than Linux, without looking. `root` is put before /proc and /sys, for tests.
int64_t available_memory(const std::string& root = "");

// A size such as "12.3 GB", for messages.
std::string gigabytes(int64_t bytes);

}  // namespace dyngs
