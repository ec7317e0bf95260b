// The estimate of a skill without Python: the package that export_estimate(skill, path) wrote.
//
//   estimate_loop PACKAGE.pt2 SECONDS_PER_TICK TICKS < numbers > estimates
//
// reads the start posture and the objects' poses (x y z qw qx qy qz each, in the order of the
// package), and prints time, mean and variances of the joints at every tick. Each mean is the
// state of the next tick. A real loop measures the objects at every tick, keeps the means within
// the robot's bounds of position, speed and acceleration, sends them, and sleeps until the next.

#include <algorithm>
#include <chrono>
#include <cstdio>
#include <cstdlib>
#include <iostream>
#include <stdexcept>
#include <string>
#include <vector>

#include <ATen/Parallel.h>
#include <ATen/ops/empty.h>
#include <ATen/ops/full.h>
#include <c10/core/InferenceMode.h>
#include <torch/csrc/inductor/aoti_package/model_package_loader.h>

using Clock = std::chrono::steady_clock;

static double milliseconds(Clock::time_point since) {
  return std::chrono::duration<double, std::milli>(Clock::now() - since).count();
}

static at::Tensor numbers(at::IntArrayRef shape) {
  at::Tensor tensor = at::empty(shape, at::kDouble);
  for (int64_t i = 0; i < tensor.numel(); ++i) {
    if (!(std::cin >> tensor.data_ptr<double>()[i])) {
      throw std::runtime_error("too few numbers: the start posture and the objects' poses");
    }
  }
  return tensor;
}

static int run(const std::string& path, double dt, int ticks) {
  at::set_num_threads(1);
  c10::InferenceMode guard;
  const auto began = Clock::now();
  torch::inductor::AOTIModelPackageLoader package(path);  // runs code: load what you trust
  const double loaded = milliseconds(began);
  auto contents = package.get_metadata();
  at::Tensor joints = numbers({std::stol(contents.at("n_joints"))});
  at::Tensor frames = numbers({std::stol(contents.at("n_frames")), 7});
  const double begin = std::stod(contents.at("begin")), end = std::stod(contents.at("end"));

  std::vector<double> taken;
  for (int tick = 0; tick < ticks; ++tick) {
    const double now = std::min(begin + tick * dt, end);
    at::Tensor time = at::full({}, now, at::kDouble);
    const auto start = Clock::now();
    std::vector<at::Tensor> out = package.run({time, joints, frames});  // mean, covariance
    taken.push_back(milliseconds(start));
    joints = out[0].contiguous();
    const at::Tensor covariance = out[1].contiguous();
    const int64_t n = joints.numel();
    std::printf("%.17g", now);
    for (int64_t i = 0; i < n; ++i) std::printf(" %.17g", joints.data_ptr<double>()[i]);
    for (int64_t i = 0; i < n; ++i) {
      std::printf(" %.17g", covariance.data_ptr<double>()[i * (n + 1)]);
    }
    std::printf("\n");
  }
  std::sort(taken.begin(), taken.end());
  std::fprintf(stderr,
               "loaded in %.1f ms; an estimate takes %.4f ms, 99 %% of them less than %.4f ms\n",
               loaded, taken[taken.size() / 2], taken[taken.size() * 99 / 100]);
  return 0;
}

int main(int argc, char** argv) {
  if (argc != 4 || std::atof(argv[2]) <= 0 || std::atoi(argv[3]) <= 0) {
    std::fprintf(stderr, "usage: %s PACKAGE.pt2 SECONDS_PER_TICK TICKS < numbers\n", argv[0]);
    return 2;
  }
  try {
    return run(argv[1], std::atof(argv[2]), std::atoi(argv[3]));
  } catch (const std::exception& error) {
    std::fprintf(stderr, "%s: %s\n", argv[0], error.what());
    return 1;
  }
}
