// chdstat_writer.h: writes the radiance samples of a renderer into a file for `chdstat import`.
//
// C++11 or newer, no dependencies, little-endian machines. MIT licence, as chdstat itself.
//
//     chdstat::Writer writer("kitchen.chds", width, height);
//     writer.set("renderer", "mine 1.2");          // provenance, as text or a whole number
//     writer.add(x, y, r, g, b);                   // one path; from any thread, in any order
//     writer.close();                              // once all threads are done
//
// A sample is the linear radiance of one path, unclamped and unweighted; zeros, negative numbers
// and NaN are samples, too. Pixel (0, 0) is at the top left. Pixels may have different numbers of
// samples.
//
// Each thread collects what it adds in a buffer of its own and appends it to the file, in whole
// blocks, when the buffer is full; call flush() where a thread should do so earlier. A program that
// is killed loses what was in the buffers: the file stays readable. An existing file is replaced.
//
// add() throws std::out_of_range for a pixel outside the image. A disk that is full stops the
// writing, not the rendering: close() throws std::runtime_error and says so.

#ifndef CHDSTAT_WRITER_H
#define CHDSTAT_WRITER_H

#include <algorithm>
#include <array>
#include <atomic>
#include <cerrno>
#include <cstddef>
#include <cstdint>
#include <cstdio>
#include <cstring>
#include <limits>
#include <map>
#include <memory>
#include <mutex>
#include <sstream>
#include <stdexcept>
#include <string>
#include <thread>
#include <vector>

namespace chdstat {

class Writer {
  public:
    // `features` names what add_features() is given, in its order, with spaces between:
    // albedo (3 numbers), normal (3), position (3), depth (1). `buffer` is bytes for each thread.
    Writer(const std::string &path, int width, int height, int channels = 3,
           const std::string &features = "", std::size_t buffer = std::size_t(4) << 20)
        : path_(path), width_(width), height_(height), channels_(std::size_t(channels)),
          tiles_((std::uint32_t(width) + EDGE - 1) / EDGE), components_(components(features)),
          limit_(std::min(std::max(buffer, std::size_t(4096)), std::size_t(1) << 30) / 4),
          serial_(++counter()) {
        static_assert(sizeof(float) == 4 && std::numeric_limits<float>::is_iec559, "IEEE floats");
        const std::uint32_t mark = 0x01020304;
        if (*reinterpret_cast<const unsigned char *>(&mark) != 4)
            throw std::runtime_error("chdstat::Writer: this machine is not little-endian");
        if (width < 1 || height < 1 || channels < 1 || width > 65536 || height > 65536 ||
            channels > 64 || std::int64_t(width) * height > 1 << 28)
            throw std::invalid_argument("chdstat::Writer: width and height must be 1 to 65536, "
                                        "at most 2^28 pixels in all, and channels 1 to 64");
        file_ = std::fopen(path.c_str(), "wb");
        if (!file_) throw std::runtime_error(failure(errno));
        std::setvbuf(file_, nullptr, _IONBF, 0);  // what is written survives a kill
        const std::string text = "\x89" "CHDS\r\n\x1a";
        const std::uint32_t numbers[] = {1, mark, std::uint32_t(width), std::uint32_t(height),
                                         std::uint32_t(channels), std::uint32_t(features.size())};
        std::uint32_t crc = crc32c(crc32c(0, text.data(), text.size()), numbers, sizeof numbers);
        crc = crc32c(crc, features.data(), features.size());
        put(text.data(), text.size()), put(numbers, sizeof numbers);
        put(features.data(), features.size()), put(&crc, sizeof crc);
    }

    // Adds one sample: one number for each channel. From any thread.
    template <class T> void add(int x, int y, const T *radiance) {
        Runs &own = mine().samples;
        if (full(own)) append_samples(own);
        count(own, place(x, y), MOST);
        float *to = own.values.get() + own.size;
        for (std::size_t c = 0; c < channels_; ++c) to[c] = static_cast<float>(radiance[c]);
        own.size += channels_;
    }

    // Adds one sample of three channels.
    void add(int x, int y, float r, float g, float b) {
        const float radiance[] = {r, g, b};
        if (channels_ != 3) throw std::invalid_argument("chdstat::Writer: expected 3 channels");
        add(x, y, radiance);
    }

    // Adds `n` samples of each pixel of a tile: radiance[row][column][sample][channel].
    template <class T>
    void add_tile(int x, int y, int width, int height, int n, const T *radiance) {
        for (int j = y; j < y + height; ++j)
            for (int i = x; i < x + width; ++i)
                for (int s = 0; s < n; ++s, radiance += channels_) add(i, j, radiance);
    }

    // Adds what a camera ray hit first, in the order of `features`: once for each pixel, or with
    // each sample; the features of a pixel are the averages of all that were added.
    template <class T> void add_features(int x, int y, const T *values) {
        Runs &own = mine().features;
        if (!components_) throw std::invalid_argument("chdstat::Writer: no features were named");
        if (full(own)) append_features(own);
        if (count(own, place(x, y), 1024)) {  // sums of more would lose precision
            std::fill_n(own.values.get() + own.size, components_, 0.0f);
            own.size += components_;
        }
        float *sums = own.values.get() + own.size - components_;
        for (std::size_t c = 0; c < components_; ++c) sums[c] += static_cast<float>(values[c]);
    }

    // Provenance: scene, renderer, integrator, unit (of radiance), seed, and whatever else is told.
    void set(const std::string &key, const std::string &value) {
        if (key.size() > 1024) throw std::invalid_argument("chdstat::Writer: a key is too long");
        write(ATTRIBUTE, 0, 0, key.data(), key.size(), value.data(), value.size());
    }
    void set(const std::string &key, long long value) { set(key, std::to_string(value)); }

    // Writes what this thread has added so far.
    void flush() { flush(mine()); }

    // Writes what all threads have added, and the end of the file. No thread may add meanwhile.
    void close() {
        if (closed_) return;
        closed_ = true;
        for (auto &own : buffers_) flush(*own.second);
        const std::uint64_t total = written_;
        write(END, 0, 0, &total, sizeof total, nullptr, 0);
        if (std::fclose(file_) != 0 && error_.empty()) error_ = failure(errno);
        file_ = nullptr;
        if (!error_.empty()) throw std::runtime_error(error_);
    }

    ~Writer() {
        try {
            close();
        } catch (const std::exception &error) {
            std::fprintf(stderr, "%s\n", error.what());
        }
    }

    Writer(const Writer &) = delete;
    Writer &operator=(const Writer &) = delete;

  private:
    enum : std::uint32_t {
        EDGE = 64,     // of the tiles that blocks belong to, in pixels
        MOST = 65535,  // samples of a pixel in a block
        SAMPLES = 1, FEATURES, ATTRIBUTE, END  // kinds of blocks
    };

    // Consecutive samples of one pixel; `place` is its tile, then the pixel within the tile.
    struct Run {
        std::uint32_t place, number, first;
    };
    struct Runs {
        std::vector<Run> runs;
        std::unique_ptr<float[]> values;  // of samples: each; of features: the sum over a run
        std::unique_ptr<float[]> body;    // of the block that is being written
        std::size_t size = 0;             // of the values
        std::size_t overhead = 64;        // room for one more, and what runs take
        explicit Runs(std::size_t most) : values(new float[most]), body(new float[most]) {}
    };
    struct Buffer {
        Runs samples, features;
        explicit Buffer(std::size_t most) : samples(most), features(most) {}
    };

    std::uint32_t place(int x, int y) const {
        const std::uint32_t i = std::uint32_t(x), j = std::uint32_t(y);
        if (i >= std::uint32_t(width_) || j >= std::uint32_t(height_) || closed_) refuse(x, y);
        return (j / EDGE * tiles_ + i / EDGE) * EDGE * EDGE + j % EDGE * EDGE + i % EDGE;
    }

    void refuse(int x, int y) const {
        std::ostringstream text;
        text << "chdstat::Writer: pixel (x = " << x << ", y = " << y << ") added to "
             << (closed_ ? "a closed file" : "an image") << " of " << width_ << " x " << height_;
        throw std::out_of_range(text.str());
    }

    bool full(const Runs &own) const {
        return own.size + own.overhead > limit_;
    }

    // Counts one more of a pixel, and returns whether that began a run.
    static bool count(Runs &own, std::uint32_t place, std::uint32_t most) {
        if (!own.runs.empty() && own.runs.back().place == place && own.runs.back().number < most) {
            ++own.runs.back().number;
            return false;
        }
        own.runs.push_back({place, 1, std::uint32_t(own.size)});
        own.overhead += sizeof(Run) / sizeof(float);
        return true;
    }

    // The buffer of the calling thread, which remembers the last that it asked for.
    Buffer &mine() {
        static thread_local std::uint64_t serial = 0;
        static thread_local Buffer *last = nullptr;
        if (serial != serial_) {
            std::lock_guard<std::mutex> lock(mutex_);
            std::unique_ptr<Buffer> &own = buffers_[std::this_thread::get_id()];
            if (!own) own.reset(new Buffer(limit_));
            last = own.get(), serial = serial_;
        }
        return *last;
    }

    void flush(Buffer &own) { append_samples(own.samples), append_features(own.features); }

    void append_samples(Runs &own) {
        const float *values = own.values.get();
        const std::size_t channels = channels_;
        append(SAMPLES, own, [=](const Run *begin, const Run *end, float *to) {
            for (std::size_t c = 0; c < channels; ++c)  // all of a channel together
                for (const Run *run = begin; run != end; ++run) {
                    const float *of = values + run->first + c;
                    for (std::uint32_t s = 0; s < run->number; ++s, of += channels) *to++ = *of;
                }
            return to;
        });
    }

    void append_features(Runs &own) {
        const float *values = own.values.get();
        const std::size_t components = components_;
        append(FEATURES, own, [=](const Run *begin, const Run *end, float *to) {
            for (std::size_t c = 0; c < components; ++c) {
                double sum = 0;
                for (const Run *run = begin; run != end; ++run) sum += values[run->first + c];
                *to++ = static_cast<float>(sum);
            }
            return to;
        });
    }

    // Appends what was collected: for each tile a block, in which every pixel comes once.
    template <class Values> void append(std::uint32_t kind, Runs &own, const Values &values) {
        const std::uint32_t size = EDGE * EDGE;
        sort(own.runs);
        std::vector<std::uint32_t> head(size);
        const Run *run = own.runs.data(), *const last = run + own.runs.size();
        while (run != last) {
            const std::uint32_t tile = run->place / size;
            std::uint32_t *entry = head.data();
            float *to = own.body.get();
            while (run != last && run->place / size == tile &&
                   (entry == head.data() || (entry[-1] & MOST) != run->place % size)) {
                const Run *const begin = run;
                std::uint32_t number = 0;
                while (run != last && run->place == begin->place && number + run->number <= MOST)
                    number += run++->number;
                *entry++ = begin->place % size | number << 16;
                to = values(begin, run, to);
            }
            write(kind, tile % tiles_ * EDGE, tile / tiles_ * EDGE,
                  head.data(), 4 * std::size_t(entry - head.data()),
                  own.body.get(), 4 * std::size_t(to - own.body.get()));
        }
        if (kind == SAMPLES) written_ += own.size / channels_;
        own.runs.clear(), own.size = 0, own.overhead = 64;
    }

    // Sorts runs by their place, and keeps the order of those of one pixel: radix sort.
    static void sort(std::vector<Run> &runs) {
        const auto less = [](const Run &a, const Run &b) { return a.place < b.place; };
        if (std::is_sorted(runs.begin(), runs.end(), less)) return;
        std::vector<Run> sorted(runs.size());
        for (int shift = 0; shift < 32; shift += 11) {
            std::array<std::uint32_t, 2048> ends{};
            for (const Run &run : runs) ++ends[run.place >> shift & 2047];
            if (*std::max_element(ends.begin(), ends.end()) == runs.size()) continue;
            std::uint32_t end = 0;
            for (std::uint32_t &e : ends) end += e, e = end - e;
            for (const Run &run : runs) sorted[ends[run.place >> shift & 2047]++] = run;
            runs.swap(sorted);
        }
    }

    // Writes a block: what it is, a head and a body, each with its checksum.
    void write(std::uint32_t kind, std::uint32_t x, std::uint32_t y, const void *head,
               std::size_t head_size, const void *body, std::size_t body_size) {
        std::uint32_t about[8] = {0x42444843, kind, x, y, std::uint32_t(head_size),
                                  std::uint32_t(body_size), 0, crc32c(0, body, body_size)};
        about[6] = crc32c(crc32c(0, about, 24), head, head_size);
        std::lock_guard<std::mutex> lock(mutex_);
        put(about, sizeof about), put(head, head_size), put(body, body_size);
    }

    void put(const void *bytes, std::size_t size) {
        if (file_ && error_.empty() && size && std::fwrite(bytes, 1, size, file_) != size)
            error_ = failure(errno);
    }

    std::string failure(int code) const {
        return "chdstat::Writer: cannot write " + path_ + ": " + std::strerror(code);
    }

    static std::size_t components(const std::string &features) {
        std::istringstream names(features);
        std::size_t found = 0;
        for (std::string name; names >> name; found += name == "depth" ? 1u : 3u)
            if ((name != "albedo" && name != "normal" && name != "position" && name != "depth") ||
                features.find(name) != features.rfind(name))
                throw std::invalid_argument("chdstat::Writer: features are albedo, normal, "
                                            "position and depth, each once; not " + name);
        return found;
    }

    // CRC-32C of bytes that follow others of the given CRC, eight at a time.
    static std::uint32_t crc32c(std::uint32_t before, const void *bytes, std::size_t left) {
        typedef std::array<std::array<std::uint32_t, 256>, 8> Tables;
        static const Tables tables = [] {
            Tables t;
            for (std::uint32_t i = 0; i < 256; ++i) {
                std::uint32_t value = i;
                for (int bit = 0; bit < 8; ++bit) value = value >> 1 ^ (value & 1) * 0x82F63B78u;
                t[0][i] = value;
            }
            for (std::size_t k = 1; k < 8; ++k)
                for (std::size_t i = 0; i < 256; ++i)
                    t[k][i] = t[k - 1][i] >> 8 ^ t[0][t[k - 1][i] & 255];
            return t;
        }();
        const unsigned char *at = static_cast<const unsigned char *>(bytes);
        std::uint32_t crc = ~before;
#if defined(__GNUC__) && defined(__x86_64__)
        if (__builtin_cpu_supports("sse4.2")) crc = crc32c_by_processor(crc, at, left);
#endif
        for (; left >= 8; at += 8, left -= 8) {
            std::uint32_t low, high;
            std::memcpy(&low, at, 4), std::memcpy(&high, at + 4, 4);
            low ^= crc;
            crc = tables[7][low & 255] ^ tables[6][low >> 8 & 255] ^ tables[5][low >> 16 & 255] ^
                  tables[4][low >> 24] ^ tables[3][high & 255] ^ tables[2][high >> 8 & 255] ^
                  tables[1][high >> 16 & 255] ^ tables[0][high >> 24];
        }
        for (; left; ++at, --left)
            crc = crc >> 8 ^ tables[0][(crc ^ *at) & 255];
        return ~crc;
    }

#if defined(__GNUC__) && defined(__x86_64__)
    __attribute__((target("sse4.2"))) static std::uint32_t
    crc32c_by_processor(std::uint32_t crc, const unsigned char *&at, std::size_t &left) {
        for (std::uint64_t value; left >= 8; at += 8, left -= 8) {
            std::memcpy(&value, at, 8);
            crc = std::uint32_t(__builtin_ia32_crc32di(crc, value));
        }
        return crc;
    }
#endif

    static std::atomic<std::uint64_t> &counter() {
        static std::atomic<std::uint64_t> made(0);
        return made;
    }

    std::string path_, error_;
    int width_, height_;
    std::size_t channels_;
    std::uint32_t tiles_;  // in a row
    std::size_t components_, limit_;
    std::uint64_t serial_;  // of this writer, by which threads know it
    std::FILE *file_ = nullptr;
    std::mutex mutex_;
    std::map<std::thread::id, std::unique_ptr<Buffer>> buffers_;
    std::atomic<std::uint64_t> written_{0};
    std::atomic<bool> closed_{false};
};

}  // namespace chdstat

#endif  // CHDSTAT_WRITER_H
