// One decoded and checked map: layers, cells, legends, and its age.
//
// In: the bytes of a `clearway.v1.Map` from any transport, also hostile bytes, and the base map of layers that are
// deltas. Out: a `Map`, or an `Error` with the first fault. A map that decodes has a meaning for each of its classes.
#pragma once

#include <chrono>
#include <map>
#include <memory>

#include "grid.hpp"

namespace clearway {

// Type of a raw cell, as on the wire.
enum class CellType : std::int32_t { U8 = 1, I8 = 2, U16 = 3 };

// Raw values in the order of the cell index, whatever their type.
using Cells = std::vector<std::int32_t>;

// What a class means to a planner; `ClassMeaning` of map.proto defines each of them. FREE alone may be entered.
enum class Meaning : std::int32_t { UNKNOWN, FREE, INFERRED, OCCUPIED, HIDDEN, NOT_REACHED, LOW };

// One class of a layer.
struct Class {
    std::string name;
    Meaning meaning = Meaning::UNKNOWN;
    // Colour in which viewers draw the class: 0xRRGGBB.
    std::uint32_t rgb = 0;
};

// One value per cell of a layer: raw * scale, in `unit`.
struct Channel {
    std::string name, unit;
    float scale = 0;
    CellType type = CellType::U8;
    // Raw value of an unknown cell.
    std::int32_t unknown = 0;
    Cells cells;

    // Value of a cell in `unit`; none if nothing is known of it.
    std::optional<double> value(std::size_t cell) const {
        if (cell >= cells.size() || cells[cell] == unknown) return std::nullopt;
        return static_cast<double>(cells[cell]) * static_cast<double>(scale);
    }
};

// A plane z = a x + b y + c in the ego frame.
struct Plane {
    double a = 0, b = 0, c = 0;
};

// A point on the medial axis of the free space. Ego frame, metres.
struct SafePoint {
    float x_m = 0, y_m = 0;
    // Distance to the nearest cell that is not free, in metres.
    float radius_m = 0;
    // Indices of earlier points that the vehicle can drive to straight from here, ascending.
    std::vector<std::uint32_t> links;
};

// One grid of a map.
struct Layer {
    std::string name;
    Grid grid;
    // The classes, by value of the channel `class`; class 0 is `unknown`.
    std::vector<Class> legend;
    std::vector<Channel> channels;
    std::vector<Plane> planes;
    std::map<std::string, double> metrics;
    std::vector<SafePoint> points;

    const Channel* channel(std::string_view wanted) const {
        const auto is_it = [&](const Channel& channel) { return channel.name == wanted; };
        const auto found = std::find_if(channels.begin(), channels.end(), is_it);
        return found == channels.end() ? nullptr : &*found;
    }

    // Class of a cell; null in a layer without classes and past the last cell.
    const Class* class_of(std::size_t cell) const {
        const Channel* classes = channel("class");
        return classes && cell < classes->cells.size() ? &legend[static_cast<std::size_t>(classes->cells[cell])]
                                                       : nullptr;
    }

    // Meaning of the class at a point; unknown outside the grid.
    Meaning meaning_at(Point point) const {
        const auto cell = grid.cell_at(point);
        const Class* found = cell ? class_of(*cell) : nullptr;
        return found ? found->meaning : Meaning::UNKNOWN;
    }
};

// Position in metres and orientation as a unit quaternion.
struct Pose {
    double x = 0, y = 0, z = 0, qx = 0, qy = 0, qz = 0, qw = 0;
};

// What holds for all layers of a map. Stamps in ns since the Unix epoch. The sensors' states are not read.
struct Header {
    std::string vehicle;
    std::uint64_t boot_id = 0, sequence = 0;
    std::int64_t capture_start_ns = 0, capture_end_ns = 0, completed_ns = 0, valid_until_ns = 0;
    // Pose of the ego frame in the world frame at `capture_end_ns`, if one is known.
    std::optional<Pose> map_from_ego;
    std::optional<double> speed_mps;
    std::uint32_t epoch = 0, wire_version = 0;
};

// Reading of this machine's clocks. The wall clock counts ns since the Unix epoch and can be set; the steady clock
// counts ns since an arbitrary moment and never goes back.
struct Clocks {
    std::int64_t wall_ns = 0, steady_ns = 0;

    static Clocks now() {
        using std::chrono::duration_cast;
        using std::chrono::nanoseconds;
        const auto wall = std::chrono::system_clock::now().time_since_epoch();
        const auto steady = std::chrono::steady_clock::now().time_since_epoch();
        return {duration_cast<nanoseconds>(wall).count(), duration_cast<nanoseconds>(steady).count()};
    }
};

// A map, decoded and checked. Age and staleness follow the clocks as in the other clients: the age starts at the end of
// the capture, and no step of the wall clock makes a stale map fresh once `arrived` was called.
class Map {
public:
    Header header;
    // In the order on the wire; names are unique.
    std::vector<Layer> layers;

    // Decodes an encoded map. `base`: the base map of layers that are deltas; whole layers do not need it. Throws
    // `Error` with the first fault.
    static Map decode(Bytes bytes, const Map* base = nullptr);

    const Layer* find(std::string_view name) const {
        const auto is_it = [&](const Layer& layer) { return layer.name == name; };
        const auto found = std::find_if(layers.begin(), layers.end(), is_it);
        return found == layers.end() ? nullptr : &*found;
    }

    // The layer with this name. Throws `Error` "layer" if the map does not have it.
    const Layer& layer(std::string_view name) const {
        if (const Layer* found = find(name)) return *found;
        std::string present;
        for (const Layer& layer : layers) present += (present.empty() ? "" : ", ") + layer.name;
        fail("layer", "no layer '", name, "'; this map has ", present);
    }

    // Sets the time at which the map came from a server. Call it once, when its bytes arrive.
    void arrived(Clocks at) {
        const std::int64_t age_ns = difference(at.wall_ns, header.capture_end_ns);
        arrival_ = Arrival{at.steady_ns, std::max<std::int64_t>(age_ns, 0)};
    }

    // Age in ns, from the end of the capture; negative before it, unless the map has arrived.
    std::int64_t age_ns(Clocks at) const {
        const std::int64_t by_wall_ns = difference(at.wall_ns, header.capture_end_ns);
        if (!arrival_) return by_wall_ns;
        return std::max(by_wall_ns, difference(arrival_->age_ns, difference(arrival_->steady_ns, at.steady_ns)));
    }

    bool is_stale(Clocks at) const { return staleness(at).has_value(); }

    // Why the map must not be used, in a sentence that all clients share; none if it may be used.
    std::optional<std::string> staleness(Clocks at) const {
        constexpr std::int64_t VALID_NS_MAX = 60'000'000'000;
        const auto ms = [](std::int64_t ns) {
            return std::to_string(std::llround(static_cast<double>(ns) * 1e-6)) + " ms";
        };
        const std::int64_t valid_ns = std::min(difference(header.valid_until_ns, header.capture_end_ns), VALID_NS_MAX);
        const std::int64_t ahead_ns = difference(header.capture_end_ns, at.wall_ns);
        if (ahead_ns > valid_ns) {
            return "it was captured " + ms(ahead_ns) + " in the future: its stamps are ahead of the reader's clock";
        }
        if (arrival_ && arrival_->age_ns > valid_ns) {
            return "it was " + ms(arrival_->age_ns) +
                   " old when it arrived: maps are delayed, its stamps are behind the reader's clock,"
                   " or a recording is replayed without --as-live";
        }
        if (age_ns(at) > valid_ns) return "no newer map has arrived";
        return std::nullopt;
    }

private:
    struct Arrival {
        std::int64_t steady_ns, age_ns;
    };

    // one - other, at the limit of the type if it is beyond.
    static std::int64_t difference(std::int64_t one, std::int64_t other) {
        using Limits = std::numeric_limits<std::int64_t>;
        if (other < 0 && one > Limits::max() + other) return Limits::max();
        if (other > 0 && one < Limits::min() + other) return Limits::min();
        return one - other;
    }

    std::optional<Arrival> arrival_;
};

}  // namespace clearway

#include "decode.hpp"
