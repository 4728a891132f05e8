// What the lines on the page of pbrt are inserted into: functions of the shape of pbrt's own, with
// just those of its names that the lines use.

#include <cstdio>
#include <memory>
#include <string>
#include <thread>
#include <vector>
#include "top.inc"

typedef float Float;
struct Vector2i { int x, y; };
struct Point2i { int x, y; };
struct Bounds2i {
    Point2i pMin, pMax;
    Vector2i Diagonal() const { return {pMax.x - pMin.x, pMax.y - pMin.y}; }
};
struct RGB { Float r, g, b; };
struct SampledWavelengths { Float lambda; };
struct SampledSpectrum { Float value; };
struct Film {
    std::string GetFilename() const { return "kitchen.exr"; }
    Bounds2i PixelBounds() const { return {{5, 3}, {45, 33}}; }
    RGB ToOutputRGB(SampledSpectrum L, const SampledWavelengths &lambda) const {
        return {L.value, lambda.lambda, 1};
    }
};
struct Camera {
    Film GetFilm() const { return {}; }
};
struct BasicPBRTOptions { int seed = 1; };
static const BasicPBRTOptions actual, *Options = &actual;
static const Camera camera{};

std::string RemoveExtension(std::string name) { return name.substr(0, name.rfind('.')); }

void EvaluatePixelSample(Point2i pPixel, int sampleIndex) {
    SampledSpectrum L{Float(pPixel.y * 100 + pPixel.x)};
    SampledWavelengths lambda{Float(sampleIndex)};
#include "sample.inc"
}

int main() {
    EvaluatePixelSample({5, 3}, 0);  // as with --debugstart
    Bounds2i pixelBounds = camera.GetFilm().PixelBounds();
    std::FILE *mseOutFile = nullptr;
#include "waves.inc"
    for (int wave = 0; wave < 3; ++wave) {
        std::vector<std::thread> threads;
        for (int first = 0; first < 4; ++first)
            threads.emplace_back([=] {
                for (int y = pixelBounds.pMin.y + first; y < pixelBounds.pMax.y; y += 4)
                    for (int x = pixelBounds.pMin.x; x < pixelBounds.pMax.x; ++x)
                        for (int s = 0; s < 8; ++s) EvaluatePixelSample({x, y}, 8 * wave + s);
            });
        for (std::thread &thread : threads) thread.join();
    }
#include "end.inc"
    if (mseOutFile) std::fclose(mseOutFile);
}
