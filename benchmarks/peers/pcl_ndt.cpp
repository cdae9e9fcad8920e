// PCL's NDT on the benchmark's own map, scan and starts: one thread, CPU time.
//
//   pcl_ndt MAP SCAN STARTS OUT
//
// MAP and SCAN are float32 x y z, STARTS float64 4x4 row-major poses (the map's frame from the
// lidar's). OUT receives per start 16 float64 of the final pose, row-major, the iterations, the
// milliseconds, and 1 where PCL says it converged.

#include <cstdio>
#include <cstdlib>
#include <ctime>
#include <fstream>
#include <vector>

#include <pcl/point_cloud.h>
#include <pcl/point_types.h>
#include <pcl/registration/ndt.h>

using Cloud = pcl::PointCloud<pcl::PointXYZ>;

template <typename T>
std::vector<T> read_all(const char *path) {
  std::ifstream file(path, std::ios::binary | std::ios::ate);
  if (!file) {
    std::fprintf(stderr, "cannot read %s\n", path);
    std::exit(2);
  }
  std::vector<T> values(static_cast<std::size_t>(file.tellg()) / sizeof(T));
  file.seekg(0);
  file.read(reinterpret_cast<char *>(values.data()), values.size() * sizeof(T));
  return values;
}

Cloud::Ptr read_cloud(const char *path) {
  const auto xyz = read_all<float>(path);
  auto cloud = std::make_shared<Cloud>();
  for (std::size_t i = 0; i + 2 < xyz.size(); i += 3)
    cloud->push_back({xyz[i], xyz[i + 1], xyz[i + 2]});
  return cloud;
}

// Milliseconds of CPU, so that another process on the machine costs neither side.
double milliseconds() {
  timespec now;
  clock_gettime(CLOCK_PROCESS_CPUTIME_ID, &now);
  return 1e3 * now.tv_sec + 1e-6 * now.tv_nsec;
}

int main(int argc, char **argv) {
  if (argc != 5) {
    std::fprintf(stderr, "usage: pcl_ndt MAP SCAN STARTS OUT\n");
    return 2;
  }
  const auto map = read_cloud(argv[1]);
  const auto scan = read_cloud(argv[2]);
  const auto starts = read_all<double>(argv[3]);

  pcl::NormalDistributionsTransform<pcl::PointXYZ, pcl::PointXYZ> ndt;
  ndt.setResolution(2.0f);
  ndt.setStepSize(0.1);
  ndt.setTransformationEpsilon(1e-4); // PCL compares it with the squared step: 0.01 m
  ndt.setMaximumIterations(30);
  double target_ms = 1e300;
  for (int repeat = 0; repeat < 3; ++repeat) {
    const double since = milliseconds();
    ndt.setInputTarget(map);
    target_ms = std::min(target_ms, milliseconds() - since);
  }
  ndt.setInputSource(scan);

  std::ofstream out(argv[4], std::ios::binary);
  Cloud aligned;
  for (std::size_t s = 0; s < starts.size() / 16; ++s) {
    Eigen::Matrix4f start;
    for (int k = 0; k < 16; ++k)
      start(k / 4, k % 4) = static_cast<float>(starts[16 * s + k]);
    const double since = milliseconds();
    ndt.align(aligned, start);
    const double ms = milliseconds() - since;
    const Eigen::Matrix4f pose = ndt.getFinalTransformation();
    double row[19];
    for (int k = 0; k < 16; ++k)
      row[k] = pose(k / 4, k % 4);
    row[16] = ndt.getFinalNumIteration();
    row[17] = ms;
    row[18] = ndt.hasConverged() ? 1.0 : 0.0;
    out.write(reinterpret_cast<const char *>(row), sizeof(row));
  }
  std::printf("{\"target_ms\": %.3f}\n", target_ms);
  return 0;
}
