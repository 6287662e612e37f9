// An estimator in C++, to copy and change: it finds the brightest spot of each frame. It needs no library.
//
//     g++ -O2 -o my_detector my_detector.cpp
//     nir-render perceive DIR --estimator "cmd: ./my_detector"
//
// The first line of standard input holds the calibrations; then comes a line per frame, answered by a line each.
#include <algorithm>
#include <cstdio>
#include <fstream>
#include <iostream>
#include <string>
#include <vector>

// The text or number behind "key" in a line of JSON; real programs take a JSON library.
static std::string value(const std::string& line, const std::string& key) {
    size_t from = line.find("\"" + key + "\": ") + key.size() + 4;
    return line[from] == '"' ? line.substr(from + 1, line.find('"', from + 1) - from - 1)
                             : line.substr(from, line.find_first_of(",}", from) - from);
}

int main() {
    std::string line;
    std::getline(std::cin, line);  // calibrations
    while (std::getline(std::cin, line)) {
        // A PGM: "P5", width, height, 65535, then counts of two bytes, the high one first.
        std::ifstream file(value(line, "pgm"), std::ios::binary);
        std::string magic;
        int width = 0, height = 0, most = 0;
        file >> magic >> width >> height >> most;
        file.get();
        std::vector<unsigned char> bytes(2 * size_t(width) * height);
        file.read(reinterpret_cast<char*>(bytes.data()), bytes.size());
        auto counts = [&](int u, int v) { size_t at = 2 * (size_t(v) * width + u); return 256.0 * bytes[at] + bytes[at + 1]; };

        int brightest_u = 0, brightest_v = 0;
        for (int v = 0; v < height; ++v)
            for (int u = 0; u < width; ++u)
                if (counts(u, v) > counts(brightest_u, brightest_v)) brightest_u = u, brightest_v = v;

        // The centroid of what stands above the black level, within five pixels of it.
        double black = std::stod(value(line, "black_level_dn")), flux = 0.0, sum_u = 0.0, sum_v = 0.0;
        for (int v = std::max(brightest_v - 5, 0); v <= std::min(brightest_v + 5, height - 1); ++v)
            for (int u = std::max(brightest_u - 5, 0); u <= std::min(brightest_u + 5, width - 1); ++u) {
                double light = std::max(counts(u, v) - black - 20.0, 0.0);
                flux += light, sum_u += light * u, sum_v += light * v;
            }
        if (flux > 0.0)
            std::printf("{\"detections\": [{\"u_px\": %.3f, \"v_px\": %.3f, \"flux_dn\": %.1f}]}\n", sum_u / flux, sum_v / flux, flux);
        else
            std::printf("{\"detections\": []}\n");
        std::fflush(stdout);  // the answer is waited for
    }
}
