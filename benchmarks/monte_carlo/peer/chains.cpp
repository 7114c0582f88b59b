// Relay chains adjusted one after the other by Ceres: the loop that a Monte Carlo study replaces.
//
//   chains STRUCTURE PIXELS START OUT [--rounds N]
//
// All files are raw little-endian float64 (see run.py). STRUCTURE: counts of stations, rows; then
// for each row: station that looks, station that carries the mark, focal length (2), principal
// point (2), sigma, camera_from_station rotation (9) and shift (3), mark in the axes of its station
// (3). PIXELS: [trials, rows, 2]. START: [stations, 6], turn and shift of world_from_station, the
// first one held. OUT gets the adjusted poses, [trials, stations, 6]. Prints seconds of every round
// and the final costs' sum as JSON.
#include <ceres/ceres.h>
#include <ceres/rotation.h>

#include <chrono>
#include <cstdio>
#include <cstdlib>
#include <fstream>
#include <iterator>
#include <string>
#include <vector>

namespace {

std::vector<double> read(const std::string& path) {
  std::ifstream file(path, std::ios::binary);
  if (!file) {
    std::fprintf(stderr, "can't read %s\n", path.c_str());
    std::exit(1);
  }
  std::vector<char> bytes{std::istreambuf_iterator<char>(file), {}};
  std::vector<double> values(bytes.size() / sizeof(double));
  std::copy(bytes.begin(), bytes.end(), reinterpret_cast<char*>(values.data()));
  return values;
}

struct Row {
  int station, carrier;
  double focal[2], centre[2], sigma, rotation[9], shift[3], mark[3];
};

// world_from_station as turn and shift: what a camera on one station sees of a mark on another.
struct Sight {
  const Row* row;
  const double* pixel;

  template <typename T>
  bool operator()(const T* const station, const T* const carrier, T* residual) const {
    const T mark[3] = {T(row->mark[0]), T(row->mark[1]), T(row->mark[2])};
    T world[3], away[3], seen[3];
    ceres::AngleAxisRotatePoint(carrier, mark, world);
    const T back[3] = {-station[0], -station[1], -station[2]};
    for (int k = 0; k < 3; ++k) away[k] = world[k] + carrier[3 + k] - station[3 + k];
    ceres::AngleAxisRotatePoint(back, away, seen);
    T camera[3];
    for (int k = 0; k < 3; ++k) {
      const double* r = row->rotation + 3 * k;
      camera[k] = r[0] * seen[0] + r[1] * seen[1] + r[2] * seen[2] + row->shift[k];
    }
    for (int k = 0; k < 2; ++k) {
      const T image = row->focal[k] * camera[k] / camera[2] + row->centre[k];
      residual[k] = (image - pixel[k]) / row->sigma;
    }
    return true;
  }
};

}  // namespace

int main(int argc, char** argv) {
  if (argc < 5) {
    std::fprintf(stderr, "chains STRUCTURE PIXELS START OUT [--rounds N]\n");
    return 2;
  }
  const int rounds = argc > 6 ? std::atoi(argv[6]) : 1;
  const std::vector<double> structure = read(argv[1]), pixels = read(argv[2]), start = read(argv[3]);
  const int stations = static_cast<int>(structure[0]), count = static_cast<int>(structure[1]);
  std::vector<Row> rows(count);
  const double* at = structure.data() + 2;
  for (Row& row : rows) {
    row.station = static_cast<int>(*at++);
    row.carrier = static_cast<int>(*at++);
    double* numbers = row.focal;
    std::copy(at, at + 20, numbers);
    at += 20;
  }
  const size_t trials = pixels.size() / (2 * count), width = 6 * stations;
  std::vector<double> found(trials * width);
  ceres::Solver::Options options;
  options.linear_solver_type = ceres::DENSE_NORMAL_CHOLESKY;
  options.function_tolerance = 1e-8;
  options.logging_type = ceres::SILENT;
  options.num_threads = 1;
  // Full Gauss-Newton steps near the solution: three evaluations, where Levenberg-Marquardt with
  // Ceres' first radius takes nine.
  options.trust_region_strategy_type = ceres::DOGLEG;
  std::printf("{\"ceres\": \"%s\", \"trials\": %zu, \"seconds\": [", CERES_VERSION_STRING, trials);
  double cost = 0.0;
  long steps = 0;
  for (int round = 0; round < rounds; ++round) {
    const auto began = std::chrono::steady_clock::now();
    cost = 0.0;
    steps = 0;
    for (size_t trial = 0; trial < trials; ++trial) {
      double* poses = found.data() + trial * width;
      std::copy(start.begin(), start.end(), poses);
      ceres::Problem problem;
      for (int i = 0; i < count; ++i) {
        auto* function = new ceres::AutoDiffCostFunction<Sight, 2, 6, 6>(
            new Sight{&rows[i], &pixels[(trial * count + i) * 2]});
        problem.AddResidualBlock(function, nullptr, poses + 6 * rows[i].station,
                                 poses + 6 * rows[i].carrier);
      }
      problem.SetParameterBlockConstant(poses);
      ceres::Solver::Summary summary;
      ceres::Solve(options, &problem, &summary);
      cost += summary.final_cost;
      steps += static_cast<long>(summary.iterations.size());
    }
    const std::chrono::duration<double> took = std::chrono::steady_clock::now() - began;
    std::printf("%s%.6f", round ? ", " : "", took.count());
  }
  std::printf("], \"cost\": %.12g, \"evaluations\": %ld}\n", cost, steps);
  std::ofstream out(argv[4], std::ios::binary);
  out.write(reinterpret_cast<const char*>(found.data()), sizeof(double) * found.size());
  return out ? 0 : 1;
}
