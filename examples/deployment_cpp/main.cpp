// A control loop without Python: the package that model.export(path) wrote.
//
//   control_loop PACKAGE.pt2 SECONDS_PER_TICK TICKS < numbers > references
//
// reads the start posture and the objects' poses (x y z qw qx qy qz each, in the order of the
// package), and prints the reference of every tick. A real loop measures both at every tick,
// sends the reference, and sleeps until the next one.

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
#include <ATen/ops/zeros.h>
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
  // a state of zeros begins the skill where the robot stands
  at::Tensor state = at::zeros({std::stol(contents.at("state_size"))}, at::kDouble);
  at::Tensor step = at::full({}, dt, at::kDouble);

  std::vector<double> taken;
  for (int tick = 0; tick < ticks; ++tick) {
    const auto start = Clock::now();
    // state, reference, velocity, covariance
    std::vector<at::Tensor> out = package.run({state, step, joints, frames});
    taken.push_back(milliseconds(start));
    state = out[0];
    joints = out[1];  // what is measured, on a robot
    for (int64_t i = 0; i < joints.numel(); ++i) {
      std::printf(i ? " %.17g" : "%.17g", joints.data_ptr<double>()[i]);
    }
    std::printf("\n");
  }
  std::sort(taken.begin(), taken.end());
  std::fprintf(stderr, "loaded in %.1f ms; a tick takes %.4f ms, 99 %% of them less than %.4f ms\n",
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
