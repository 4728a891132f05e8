// A path tracer of a box with some balls. What keeps its samples are the lines with `writer`.
//
//     g++ -O2 -std=c++17 -pthread -I$(chdstat include) tracer.cpp -o tracer
//     ./tracer box.chds 128 128 256
//     chdstat import box.chds -o box.zarr

#include "chdstat_writer.h"

#include <atomic>
#include <cmath>
#include <cstdio>
#include <cstdlib>
#include <memory>
#include <thread>
#include <vector>

struct Vec {
    double x, y, z;
    Vec operator+(Vec b) const { return {x + b.x, y + b.y, z + b.z}; }
    Vec operator-(Vec b) const { return {x - b.x, y - b.y, z - b.z}; }
    Vec operator*(Vec b) const { return {x * b.x, y * b.y, z * b.z}; }
    Vec operator*(double s) const { return {x * s, y * s, z * s}; }
};
double dot(Vec a, Vec b) { return a.x * b.x + a.y * b.y + a.z * b.z; }
Vec cross(Vec a, Vec b) {
    return {a.y * b.z - a.z * b.y, a.z * b.x - a.x * b.z, a.x * b.y - a.y * b.x};
}
Vec unit(Vec a) { return a * (1 / std::sqrt(dot(a, a))); }

// Random numbers: a 64-bit congruential generator, of which the high bits are mixed.
struct Random {
    std::uint64_t state;
    explicit Random(std::uint64_t seed) : state(seed * 2654435769u + 1) { next(), next(); }
    double next() {
        state = state * 6364136223846793005u + 1442695040888963407u;
        std::uint64_t bits = (state ^ state >> 29) * 0xBF58476D1CE4E5B9u;
        return double(bits >> 11) * 0x1p-53;
    }
};

const double PI = 3.14159265358979323846, FAR = 1e30, NEAR = 1e-6;
const double LIGHT = 0.25;              // half the edge of the square light in the ceiling
const Vec RADIANCE = {15, 13, 9}, BLACK = {0, 0, 0};

struct Hit {
    double distance;
    Vec point, normal, albedo;
    bool light, mirror;
};

struct Wall {
    int axis;
    double at;
    Vec normal, albedo;
};
// The box is x and y from -1 to 1, z from -1 to 1, open towards the camera at z = 4.
const Wall WALLS[] = {{0, -1, {1, 0, 0}, {.65, .08, .06}}, {0, 1, {-1, 0, 0}, {.1, .45, .12}},
                      {1, -1, {0, 1, 0}, {.7, .7, .7}},    {1, 1, {0, -1, 0}, {.7, .7, .7}},
                      {2, -1, {0, 0, 1}, {.7, .7, .7}}};
struct Ball {
    Vec centre;
    double radius;
    Vec albedo;
    bool mirror;
};
const Ball BALLS[] = {{{-.45, -.6, -.3}, .4, {.95, .95, .95}, true},
                      {{.45, -.65, .2}, .35, {.75, .6, .3}, false},
                      {{-.1, -.85, .5}, .15, {.3, .45, .75}, false},
                      {{.75, -.88, .7}, .12, {.95, .95, .95}, true},
                      {{.1, -.9, -.6}, .1, {.7, .2, .5}, false},
                      {{.35, -.2, .25}, .12, {.9, .8, .7}, true}};

double along(Vec v, int axis) { return axis == 0 ? v.x : axis == 1 ? v.y : v.z; }

// The first surface that a ray meets; its distance is FAR where there is none.
Hit intersect(Vec origin, Vec direction) {
    Hit hit = {FAR, BLACK, BLACK, BLACK, false, false};
    for (const Wall &wall : WALLS) {
        double slope = along(direction, wall.axis);
        double t = (wall.at - along(origin, wall.axis)) / slope;
        if (slope == 0 || t < NEAR || t >= hit.distance) continue;
        Vec p = origin + direction * t;
        if (std::fabs(p.x) > 1 + NEAR || std::fabs(p.y) > 1 + NEAR || std::fabs(p.z) > 1 + NEAR)
            continue;
        bool light = wall.normal.y < 0 && std::fabs(p.x) < LIGHT && std::fabs(p.z) < LIGHT;
        hit = {t, p, wall.normal, wall.albedo, light, false};
    }
    for (const Ball &ball : BALLS) {
        Vec to = ball.centre - origin;
        double b = dot(to, direction), d = b * b - dot(to, to) + ball.radius * ball.radius;
        if (d < 0) continue;
        double t = b - std::sqrt(d) > NEAR ? b - std::sqrt(d) : b + std::sqrt(d);
        if (t < NEAR || t >= hit.distance) continue;
        Vec p = origin + direction * t;
        hit = {t, p, unit(p - ball.centre), ball.albedo, false, ball.mirror};
    }
    return hit;
}

// Light that comes to a point directly from the square, of one random point of it.
Vec direct(const Hit &hit, Random &random) {
    Vec to = Vec{LIGHT * (2 * random.next() - 1), 1, LIGHT * (2 * random.next() - 1)} - hit.point;
    double squared = dot(to, to), distance = std::sqrt(squared);
    Vec direction = to * (1 / distance);
    double here = dot(hit.normal, direction), there = direction.y;
    if (here <= 0 || there <= 0 || distance < NEAR) return BLACK;
    if (intersect(hit.point, direction).distance < distance - 1e-4) return BLACK;
    return hit.albedo * RADIANCE * (here * there / squared * 4 * LIGHT * LIGHT / PI);
}

// The radiance of one path.
Vec trace(Vec origin, Vec direction, Random &random, Hit &first) {
    Vec radiance = BLACK, throughput = {1, 1, 1};
    bool counts = true;  // whether a light that is hit was not sampled before
    for (int depth = 0; depth < 32; ++depth) {
        Hit hit = intersect(origin, direction);
        if (depth == 0) first = hit;
        if (hit.distance == FAR) break;
        if (hit.light) return counts ? radiance + throughput * RADIANCE : radiance;
        origin = hit.point, counts = hit.mirror;
        if (hit.mirror) {
            direction = direction - hit.normal * (2 * dot(hit.normal, direction));
            throughput = throughput * hit.albedo;
            continue;
        }
        radiance = radiance + throughput * direct(hit, random);
        throughput = throughput * hit.albedo;
        double survives = std::fmax(throughput.x, std::fmax(throughput.y, throughput.z));
        if (depth > 3 && random.next() >= survives) break;
        if (depth > 3) throughput = throughput * (1 / survives);
        double angle = 2 * PI * random.next(), u = random.next(), r = std::sqrt(u);
        Vec s = unit(cross(std::fabs(hit.normal.x) > .5 ? Vec{0, 1, 0} : Vec{1, 0, 0}, hit.normal));
        Vec t = cross(hit.normal, s);
        direction = unit(s * (r * std::cos(angle)) + t * (r * std::sin(angle)) +
                         hit.normal * std::sqrt(1 - u));
    }
    return radiance;
}

int main(int count, char **given) {
    if (count < 5) return std::puts("usage: tracer OUT.chds|- WIDTH HEIGHT SPP [SEED] [IMAGE]"), 1;
    const int width = std::atoi(given[2]), height = std::atoi(given[3]), spp = std::atoi(given[4]);
    const int seed = count > 5 ? std::atoi(given[5]) : 0, edge = 16;

    std::unique_ptr<chdstat::Writer> writer;
    if (given[1][0] != '-') {
        writer.reset(new chdstat::Writer(given[1], width, height, 3, "albedo normal depth"));
        writer->set("scene", "box");
        writer->set("renderer", "tracer.cpp");
        writer->set("seed", seed);
    }

    std::vector<float> image(std::size_t(3 * width * height));
    std::atomic<int> next{0};
    const int columns = (width + edge - 1) / edge, tiles = columns * ((height + edge - 1) / edge);
    auto work = [&] {
        for (int tile; (tile = next++) < tiles;) {
            const int top = tile / columns * edge, left = tile % columns * edge;
            for (int y = top; y < std::min(height, top + edge); ++y)
                for (int x = left; x < std::min(width, left + edge); ++x) {
                    Random random(std::uint64_t(seed) * 1000003 + std::uint64_t(y * width + x));
                    Vec sum = BLACK;
                    for (int s = 0; s < spp; ++s) {
                        Vec to = {2 * (x + random.next()) - width, height - 2 * (y + random.next()),
                                  -3.05 * height};
                        Hit first = {};
                        Vec radiance = trace({0, 0, 4}, unit(to), random, first);
                        sum = sum + radiance;
                        if (writer) writer->add(x, y, &radiance.x);
                        if (writer && s < 16) {  // those of a few paths are enough
                            const Vec at[] = {first.albedo, first.normal, {first.distance, 0, 0}};
                            writer->add_features(x, y, &at[0].x);
                        }
                    }
                    const double mean[] = {sum.x / spp, sum.y / spp, sum.z / spp};
                    for (int c = 0; c < 3; ++c)
                        image[std::size_t(3 * (y * width + x) + c)] = float(mean[c]);
                }
        }
    };
    std::vector<std::thread> threads;
    for (unsigned i = 0; i < std::max(1u, std::thread::hardware_concurrency()); ++i)
        threads.emplace_back(work);
    for (std::thread &thread : threads) thread.join();
    if (writer) writer->close();

    if (count > 6) {  // the mean of each pixel, as plain numbers
        std::FILE *file = std::fopen(given[6], "wb");
        if (!file || std::fwrite(image.data(), sizeof(float), image.size(), file) != image.size())
            return std::perror(given[6]), 1;
        std::fclose(file);
    }
    return 0;
}
