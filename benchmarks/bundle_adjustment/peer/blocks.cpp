// Ceres on a problem of Bundle Adjustment in the Large (Agarwal et al. 2010), in its text format.
//
//   blocks FILE SOLVER [THREADS]
//
// SOLVER is dense_schur, sparse_schur or iterative_schur. Nothing is held, no loss; the points are
// eliminated first; steps end where the cost changes by less than 1e-7 of itself. Prints JSON: the
// version of Ceres, the peak memory and, for each iteration, the least cost so far (half the sum of
// squares) and the seconds since Solve was called, as Ceres itself reports them.
#include <ceres/ceres.h>
#include <ceres/rotation.h>

#include <algorithm>
#include <cstdio>
#include <cstdlib>
#include <fstream>
#include <memory>
#include <string>
#include <vector>

namespace {

// Camera: angle-axis, shift, focal length, k1, k2; it looks along -z and v points up.
struct Sight {
  double u, v;

  template <typename T>
  bool operator()(const T* const camera, const T* const point, T* residual) const {
    T seen[3];
    ceres::AngleAxisRotatePoint(camera, point, seen);
    for (int k = 0; k < 3; ++k) seen[k] += camera[3 + k];
    const T x = -seen[0] / seen[2], y = -seen[1] / seen[2];
    const T r2 = x * x + y * y;
    const T scale = camera[6] * (1.0 + r2 * (camera[7] + camera[8] * r2));
    residual[0] = scale * x - u;
    residual[1] = scale * y - v;
    return true;
  }
};

struct Row {
  int camera, point;
  double u, v;
};

// Peak memory of this process; -1 where the system does not tell.
long peak_kb() {
  std::ifstream status("/proc/self/status");
  for (std::string word; status >> word;) {
    if (word == "VmHWM:") {
      long kb = -1;
      status >> kb;
      return kb;
    }
  }
  return -1;
}

}  // namespace

int main(int argc, char** argv) {
  if (argc < 3) {
    std::fprintf(stderr, "blocks FILE SOLVER [THREADS]\n");
    return 2;
  }
  std::ifstream file(argv[1]);
  int cameras = 0, points = 0, count = 0;
  if (!(file >> cameras >> points >> count)) {
    std::fprintf(stderr, "%s: can't read the three counts of its first line\n", argv[1]);
    return 1;
  }
  std::vector<Row> rows(count);
  for (Row& row : rows) file >> row.camera >> row.point >> row.u >> row.v;
  std::vector<double> camera(9 * cameras), point(3 * points);
  for (double& value : camera) file >> value;
  for (double& value : point) file >> value;
  if (!file) {
    std::fprintf(stderr, "%s: ends before its %d cameras and %d points\n", argv[1], cameras, points);
    return 1;
  }

  ceres::Problem problem;
  auto ordering = std::make_shared<ceres::ParameterBlockOrdering>();
  for (const Row& row : rows) {
    double* of_camera = &camera[9 * row.camera];
    double* of_point = &point[3 * row.point];
    problem.AddResidualBlock(
        new ceres::AutoDiffCostFunction<Sight, 2, 9, 3>(new Sight{row.u, row.v}), nullptr,
        of_camera, of_point);
    ordering->AddElementToGroup(of_point, 0);
    ordering->AddElementToGroup(of_camera, 1);
  }

  ceres::Solver::Options options;
  std::string error, solver = argv[2];
  std::transform(solver.begin(), solver.end(), solver.begin(), ::toupper);
  if (!ceres::StringToLinearSolverType(solver, &options.linear_solver_type)) {
    std::fprintf(stderr, "%s is no solver of Ceres\n", argv[2]);
    return 2;
  }
  options.linear_solver_ordering = ordering;
  options.num_threads = argc > 3 ? std::atoi(argv[3]) : 2;
  options.max_num_iterations = 100;
  options.function_tolerance = 1e-7;
  options.gradient_tolerance = 0.0;
  options.parameter_tolerance = 0.0;
  options.logging_type = ceres::SILENT;
  if (!options.IsValid(&error)) {
    std::fprintf(stderr, "%s\n", error.c_str());
    return 2;
  }
  ceres::Solver::Summary summary;
  ceres::Solve(options, &problem, &summary);

  std::printf("{\"ceres\": \"%s\", \"threads\": %d, \"peak_kb\": %ld, \"run\": [",
              CERES_VERSION_STRING, summary.num_threads_used, peak_kb());
  double least = summary.initial_cost;
  for (const auto& step : summary.iterations) {
    // The cost of a step that is refused is that of the place where it remains.
    least = std::min(least, step.cost);
    std::printf("%s[%.17g, %.6f]", step.iteration > 0 ? ", " : "", least,
                step.cumulative_time_in_seconds);
  }
  std::printf("]}\n");
  return 0;
}
