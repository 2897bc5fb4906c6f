// Answers of the C++ client to one request a line, each as one line of JSON. `tests/tests/readers/cpp.rs` writes the
// requests from the golden vectors and compares the answers. Bytes are in hexadecimal digits, `-` if there are none.
//
//   map <base> <map>                                          the decoded map; floating-point numbers as their bits
//   channel <type> <encoding> <count> <columns> <crc> <payload>   the cells
//   use <map>                                                 the map of the questions that follow
//   stale <on arrival ns> <since ns>                          why that map is stale if it arrives at this age
//   answer <layer> <x> <y> ...                                of a polygon
//   arc <layer> <outline> <curvature> <length>                of a path; so does `places <layer> <outline> <x> <y> ...`
//   nearest_obstacle <layer> <x> <y> [<outline>]              so does `nearest_low`
//   clearance <layer> <most> <passes low things: 0 or 1>
//   address <certificates: 0 or 1> <address>                  what is wrong with it, as text
//
// With the macro CLEARWAY_STREAM also, of a server:
//
//   watch <address> <once, or reconnects> <deltas: 0 or 1> [@<vehicle>] <layer> ...   opens a stream of maps
//   next [<timeout ms>]                                       waits for a map or for STALE; the map of the questions
//   reasons                                                   why no map comes
#include <clearway/address.hpp>
#include <clearway/questions.hpp>
#ifdef CLEARWAY_STREAM
#include <clearway/grpc.hpp>
#endif

#include <cstdlib>
#include <iostream>
#include <sstream>

namespace {

using namespace clearway;

std::string from_hex(const std::string& digits) {
    std::string bytes;
    for (std::size_t at = 0; at + 1 < digits.size(); at += 2) {
        bytes.push_back(static_cast<char>(std::stoi(digits.substr(at, 2), nullptr, 16)));
    }
    return bytes;
}

std::string hex(const std::string& text) {
    std::string digits = "\"";
    for (const char byte : text) {
        for (const int shift : {4, 0}) digits += "0123456789abcdef"[static_cast<unsigned char>(byte) >> shift & 15];
    }
    return digits + "\"";
}

template <class To, class Number>
std::string bits(Number number) {
    To value;
    static_assert(sizeof value == sizeof number);
    std::memcpy(&value, &number, sizeof value);
    return std::to_string(value);
}
std::string bits(double number) { return bits<std::uint64_t>(number); }
std::string bits(float number) { return bits<std::uint32_t>(number); }

std::string json(double number) {
    char text[40];
    std::snprintf(text, sizeof text, "%.17g", number);
    return text;
}

template <class List, class Show>
std::string list(const List& items, Show show) {
    std::string text = "[";
    for (const auto& item : items) text += (text.size() > 1 ? "," : "") + show(item);
    return text + "]";
}

std::string show(const Grid& grid) {
    if (const RadialGrid* rings = grid.radial()) {
        return "[" + list(rings->row_radius_m, [](float radius) { return bits(radius); }) + "," +
               std::to_string(rings->columns) + "," + bits(rings->centre_x_m) + "," + bits(rings->centre_y_m) + "]";
    }
    const CartesianGrid& squares = *grid.cartesian();
    return "[" + bits(squares.origin_x_m) + "," + bits(squares.origin_y_m) + "," + std::to_string(squares.width) + "," +
           std::to_string(squares.height) + "," + bits(squares.cell_m) + "," + bits(squares.yaw_rad) + "," +
           std::to_string(squares.first_ix) + "," + std::to_string(squares.first_iy) + "]";
}

std::string show(const Layer& layer) {
    const auto number = [](auto value) { return std::to_string(value); };
    const auto classes = list(layer.legend, [](const Class& one) {
        return "[" + hex(one.name) + "," + std::to_string(static_cast<int>(one.meaning)) + "," +
               std::to_string(one.rgb) + "]";
    });
    const auto channels = list(layer.channels, [&](const Channel& one) {
        return "[" + hex(one.name) + "," + hex(one.unit) + "," + bits(one.scale) + "," +
               std::to_string(static_cast<int>(one.type)) + "," + std::to_string(one.unknown) + "," +
               list(one.cells, number) + "]";
    });
    const auto planes = list(layer.planes, [](const Plane& one) {
        return "[" + bits(one.a) + "," + bits(one.b) + "," + bits(one.c) + "]";
    });
    const auto metrics = list(layer.metrics, [](const std::pair<const std::string, double>& one) {
        return "[" + hex(one.first) + "," + bits(one.second) + "]";
    });
    const auto points = list(layer.points, [&](const SafePoint& one) {
        return "[" + bits(one.x_m) + "," + bits(one.y_m) + "," + bits(one.radius_m) + "," + list(one.links, number) +
               "]";
    });
    return "[" + hex(layer.name) + "," + show(layer.grid) + "," + classes + "," + channels + "," + planes + "," +
           metrics + "," + points + "]";
}

std::string show(const Map& map) {
    const Header& header = map.header;
    std::string pose = "null";
    if (const auto& p = header.map_from_ego) {
        pose = list(std::array<double, 7>{p->x, p->y, p->z, p->qx, p->qy, p->qz, p->qw}, [](double v) { return bits(v); });
    }
    std::string text = "[" + hex(header.vehicle) + "," + std::to_string(header.boot_id) + "," +
                       std::to_string(header.sequence) + "," + std::to_string(header.epoch);
    for (const auto stamp : {header.capture_start_ns, header.capture_end_ns, header.completed_ns, header.valid_until_ns}) {
        text += "," + std::to_string(stamp);
    }
    text += "," + pose + "," + (header.speed_mps ? bits(*header.speed_mps) : "null");
    return text + "," + list(map.layers, [](const Layer& layer) { return show(layer); }) + "]";
}

std::string show(const Blocker& blocker) {
    const std::string why = blocker.why ? "\"" + *blocker.why + "\"" : "null";
    return "[" + json(blocker.at.x_m) + "," + json(blocker.at.y_m) + ",\"" + blocker.name + "\"," + why + "]";
}

std::string show(const std::optional<Met>& met) {
    return met ? "[" + json(met->along_m) + "," + show(met->blocker) + "]" : "null";
}

std::string show(const Along& met) {
    return "[" + json(met.length_m) + "," + show(met.low) + "," + show(met.blocked) + "]";
}

std::string show(const std::optional<Obstacle>& found) {
    if (!found) return "null";
    return "[" + json(found->at.x_m) + "," + json(found->at.y_m) + "," + json(found->distance_m) + ",\"" + found->name +
           "\"]";
}

// The words of one request. A number can also be `NaN`, `inf` or `-inf`.
struct Words {
    std::istringstream line;

    std::string word() {
        std::string word;
        line >> word;
        return word;
    }
    bool has_more() { return !(line >> std::ws).eof(); }
    // Also a number too small for a whole mantissa, which `std::stod` refuses.
    double number() { return std::strtod(word().c_str(), nullptr); }
    Point point() {
        const double x_m = number();
        return {x_m, number()};
    }
    std::vector<Point> points() {
        std::vector<Point> read;
        while (has_more()) read.push_back(point());
        return read;
    }
    Outline outline() {
        const double front_m = number(), rear_m = number();
        return {front_m, rear_m, number()};
    }
};

#ifdef CLEARWAY_STREAM
// The answer to a request about a stream; none if it is another request.
std::optional<std::string> answered_by_stream(const std::string& ask, Words& words, Map& map) {
    static std::optional<MapStream> stream;
    if (ask == "watch") {
        const std::string address = words.word();
        Subscription wanted;
        wanted.reconnects = words.word() == "reconnects";
        wanted.deltas = words.word() == "1";
        while (words.has_more()) wanted.layers.push_back(words.word());
        if (!wanted.layers.empty() && wanted.layers[0][0] == '@') {
            wanted.vehicle = wanted.layers[0].substr(1);
            wanted.layers.erase(wanted.layers.begin());
        }
        stream.emplace(address, wanted);
        return "null";
    }
    if (ask == "next") {
        std::optional<std::chrono::milliseconds> timeout;
        if (words.has_more()) timeout = std::chrono::milliseconds(static_cast<int>(words.number()));
        const auto found = stream->next(timeout);
        if (!found) return "null";
        map = *found;
        const bool is_stale = map.is_stale(Clocks::now());
        return "[" + std::to_string(map.header.boot_id) + "," + std::to_string(map.header.sequence) + "," +
               std::to_string(stream->skipped()) + "," + std::to_string(stream->left_out()) + "," +
               (is_stale ? "true" : "false") + "]";
    }
    if (ask == "reasons") return list(stream->reasons(), hex);
    return std::nullopt;
}
#else
std::optional<std::string> answered_by_stream(const std::string&, Words&, Map&) { return std::nullopt; }
#endif

std::string answered(Words& words, Map& map) {
    const std::string ask = words.word();
    if (const auto answer = answered_by_stream(ask, words, map)) return *answer;
    if (ask == "map") {
        const std::string base = words.word(), bytes = from_hex(words.word());
        if (base == "-") return show(Map::decode(bytes));
        const Map before = Map::decode(from_hex(base));
        return show(Map::decode(bytes, &before));
    }
    if (ask == "channel") {
        decoding::RawChannel raw;
        raw.cell_type = std::stoi(words.word());
        raw.encoding = std::stoi(words.word());
        raw.cell_count = static_cast<std::uint32_t>(std::stoul(words.word()));
        const std::size_t columns = std::stoul(words.word());
        raw.crc32 = static_cast<std::uint32_t>(std::stoul(words.word()));
        const std::string payload = from_hex(words.word());
        raw.payload = payload;
        const Cells cells = decoding::decode_cells(raw, columns, std::nullopt);
        return list(cells, [](std::int32_t cell) { return std::to_string(cell); });
    }
    if (ask == "address") {
        const bool has_certificates = words.word() == "1";
        std::string target;
        return hex(wrong_address(words.word(), has_certificates, target));
    }
    if (ask == "use") {
        map = Map::decode(from_hex(words.word()));
        return "null";
    }
    if (ask == "stale") {
        const auto on_arrival_ns = std::stoll(words.word()), since_ns = std::stoll(words.word());
        const Clocks then{map.header.capture_end_ns + on_arrival_ns, 0};
        map.arrived(then);
        const auto because = map.staleness({then.wall_ns + since_ns, since_ns});
        return because ? "\"" + *because + "\"" : "null";
    }
    const Layer& layer = map.layer(words.word());
    if (ask == "answer") {
        const Answer found = answer(layer, words.points());
        const char* const names[] = {"free", "low", "blocked"};
        return "[\"" + std::string(names[static_cast<int>(found.verdict)]) + "\"," +
               (found.blocker ? show(*found.blocker) : "null") + "]";
    }
    if (ask == "arc" || ask == "places") {
        const Outline outline = words.outline();
        if (ask == "places") return show(along(layer, words.points(), outline));
        const double curvature_per_m = words.number();
        return show(along(layer, Arc{curvature_per_m, words.number()}, outline));
    }
    if (ask == "clearance") {
        const double most_m = words.number();
        return list(clearance(layer, most_m, words.word() == "1"), json);
    }
    const Point to = words.point();
    std::optional<Outline> own;
    if (words.has_more()) own = words.outline();
    return show((ask == "nearest_low" ? nearest_low : nearest_obstacle)(layer, to, own ? &*own : nullptr));
}

}  // namespace

int main() {
    clearway::Map map;
    for (std::string line; std::getline(std::cin, line);) {
        Words words{std::istringstream(line)};
        try {
            std::cout << answered(words, map) << "\n";
        } catch (const clearway::Error& error) {
            std::cout << "{\"error\":\"" << error.reason() << "\"}\n";
        }
    }
}
