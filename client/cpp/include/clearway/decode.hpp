// The bytes of a map -> `Map`, with the checks of `proto/src/map/decode.rs` in the same order.
#pragma once

#include <set>

#include "cells.hpp"
#include "map.hpp"

namespace clearway::decoding {

using namespace wire;

// A channel as on the wire.
struct RawChannel {
    Channel channel;
    std::int32_t cell_type = 0, encoding = 0;
    std::uint32_t cell_count = 0, crc32 = 0;
    Bytes payload, by_class;
};

// Safe points as on the wire: differences.
struct RawPoints {
    float step_m = 0;
    std::vector<std::int32_t> x, y, radius_cm;
    std::vector<std::uint32_t> starts, link_from, link_back;
};

// A layer as on the wire. Its grid has no cells if none was sent.
struct RawLayer {
    Layer layer;
    std::vector<std::string> names;
    std::vector<std::int32_t> meanings;
    std::vector<std::uint32_t> colours;
    std::vector<RawChannel> channels;
    std::optional<RawPoints> points;
    std::optional<std::uint64_t> base_sequence;
};

// Counts layers, channels, planes, sensors and names, up to the first byte that is not protobuf; stops above the limit.
inline void count_parts(Bytes message, bool is_map, std::size_t& parts) try {
    for (Fields fields(message); parts <= MAP_PARTS_MAX && fields.next();) {
        if (!fields.has_content()) continue;
        ++parts;
        if (is_map && fields.tag() <= 2) count_parts(fields.content(), false, parts);
    }
} catch (const Error&) {
    // The decoder stops there too, and names the fault.
}

inline void read_header(Bytes message, Header& h) {
    const auto pose = [&](Bytes content) {
        Pose& p = h.map_from_ego ? *h.map_from_ego : h.map_from_ego.emplace();
        read(content, p.x, p.y, p.z, p.qx, p.qy, p.qz, p.qw);
    };
    const Unread other;
    read(message, h.vehicle, fixed(h.boot_id), h.sequence, fixed(h.capture_start_ns), fixed(h.capture_end_ns),
         fixed(h.completed_ns), fixed(h.valid_until_ns), pose, h.speed_mps, other, other, other, other, h.epoch, other,
         h.wire_version);
}

// The alternative of a `oneof`, as it is or made now.
template <class Kind>
Kind& kept(std::variant<RadialGrid, CartesianGrid>& grid) {
    return std::holds_alternative<Kind>(grid) ? std::get<Kind>(grid) : grid.emplace<Kind>();
}

inline RawLayer read_layer(Bytes message) {
    RawLayer raw;
    const auto radial = [&](Bytes content) {
        auto& grid = kept<RadialGrid>(raw.layer.grid);
        read(content, grid.row_radius_m, grid.columns, grid.centre_x_m, grid.centre_y_m);
    };
    const auto cartesian = [&](Bytes content) {
        auto& grid = kept<CartesianGrid>(raw.layer.grid);
        read(content, grid.origin_x_m, grid.origin_y_m, grid.width, grid.height, grid.cell_m, grid.yaw_rad,
             zigzag(grid.first_ix), zigzag(grid.first_iy));
    };
    const auto channel = [&](Bytes content) {
        RawChannel& one = raw.channels.emplace_back();
        Channel& as = one.channel;
        read(content, as.name, as.unit, as.scale, one.cell_type, zigzag(as.unknown), one.encoding, one.cell_count,
             fixed(one.crc32), one.payload, one.by_class);
    };
    const auto plane = [&](Bytes content) {
        Plane& one = raw.layer.planes.emplace_back();
        read(content, one.a, one.b, one.c);
    };
    const auto metric = [&](Bytes content) {
        std::pair<std::string, double> one;
        read(content, one.first, one.second);
        raw.layer.metrics[one.first] = one.second;
    };
    const auto points = [&](Bytes content) {
        RawPoints& of = raw.points ? *raw.points : raw.points.emplace();
        read(content, of.step_m, zigzag(of.x), zigzag(of.y), zigzag(of.radius_cm), of.starts, of.link_from,
             of.link_back);
    };
    read(message, raw.layer.name, radial, cartesian, raw.names, channel, plane, metric, Unread{}, points,
         raw.base_sequence, raw.meanings, fixed(raw.colours));
    return raw;
}

inline void check_header(const Header& header) {
    require(header.wire_version <= WIRE_VERSION, "version", "wire of version ", header.wire_version,
            "; this reader knows versions up to ", WIRE_VERSION);
    require(header.capture_start_ns <= header.capture_end_ns, "header", "capture starts at ", header.capture_start_ns,
            " ns; that is after its end at ", header.capture_end_ns, " ns");
    if (!header.map_from_ego) return;
    const Pose& p = *header.map_from_ego;
    const double norm = std::sqrt(p.qx * p.qx + p.qy * p.qy + p.qz * p.qz + p.qw * p.qw);
    const bool is_finite = std::isfinite(p.x) && std::isfinite(p.y) && std::isfinite(p.z) && std::isfinite(norm);
    require(is_finite && std::abs(norm - 1.0) <= 1e-3, "header", "map_from_ego has a quaternion of norm ", norm,
            "; finite metres and norm 1 are needed");
}

inline void check_grid(const Grid& grid) {
    require(grid.cell_count() > 0, "geometry", "0 cells; a radial or Cartesian grid with at least 1 is needed");
    if (const RadialGrid* rings = grid.radial()) {
        float inner = 0;
        for (const float outer : rings->row_radius_m) {
            const bool is_right = std::isfinite(outer) && outer > inner;
            require(is_right, "geometry", "a radius of ", outer, " m; finite, ascending radii are needed");
            inner = outer;
        }
        const bool is_finite = std::isfinite(rings->centre_x_m) && std::isfinite(rings->centre_y_m);
        return require(is_finite, "geometry", "a centre that is not finite");
    }
    const CartesianGrid& of = *grid.cartesian();
    require(std::isfinite(of.cell_m) && of.cell_m > 0, "geometry", "cells of ", of.cell_m, " m; over 0 m are needed");
    const bool is_finite = std::isfinite(of.origin_x_m) && std::isfinite(of.origin_y_m) && std::isfinite(of.yaw_rad);
    require(is_finite, "geometry", "an origin or a yaw that is not finite");
}

// Rows and columns from the cells of a grid to the cells of its base layer at the same places. Grids that are farther
// apart than this share no cell.
struct Shift {
    static constexpr std::int64_t FAR = std::int64_t{1} << 32;
    std::int64_t rows = 0, columns = 0;
};

inline Shift shift_of(const Grid& base, const Grid& grid) {
    const RadialGrid *before = base.radial(), *now = grid.radial();
    const CartesianGrid *squares = base.cartesian(), *moved = grid.cartesian();
    const bool is_same = before && now ? *before == *now : squares && moved && squares->cell_m == moved->cell_m;
    require(is_same, "base_shape", "a delta to a grid that is not comparable");
    if (now) return {};
    const auto steps = [](std::int64_t to, std::int64_t from) {
        const double far = static_cast<double>(to) - static_cast<double>(from);
        return std::abs(far) < static_cast<double>(Shift::FAR) ? to - from : far < 0 ? -Shift::FAR : Shift::FAR;
    };
    return {steps(moved->first_iy, squares->first_iy), steps(moved->first_ix, squares->first_ix)};
}

// The base of a delta's channel: the base layer's cells at the places of the grid, `unknown` where it has none.
inline Cells shifted(const RawChannel& raw, const Layer& base, const Layer& layer, const Shift& by) {
    const Channel* before = base.channel(raw.channel.name);
    require(before && static_cast<std::int32_t>(before->type) == raw.cell_type, "base_shape",
            "the base has no channel '", raw.channel.name, "' of cell type ", raw.cell_type);
    Cells cells(raw.cell_count, codec::wrapped(before->type, static_cast<std::uint32_t>(raw.channel.unknown)));
    const auto columns = static_cast<std::int64_t>(layer.grid.columns());
    const auto from_rows = static_cast<std::int64_t>(base.grid.rows());
    const auto from_columns = static_cast<std::int64_t>(base.grid.columns());
    const auto first = std::max<std::int64_t>(0, -by.columns), last = std::min(columns, from_columns - by.columns);
    for (std::int64_t row = 0; row * columns < raw.cell_count && first < last; ++row) {
        const std::int64_t from = row + by.rows;
        if (from < 0 || from >= from_rows) continue;
        std::copy_n(before->cells.begin() + from * from_columns + first + by.columns, last - first,
                    cells.begin() + row * columns + first);
    }
    return cells;
}

// The base of a channel with a class table: the table's value for the class of each cell.
inline Cells looked_up(const RawChannel& raw, const Layer& layer) {
    const auto type = raw.cell_type == 2 || raw.cell_type == 3 ? static_cast<CellType>(raw.cell_type) : CellType::U8;
    const Channel* classes = layer.channel("class");
    const std::size_t known = layer.legend.size();
    const auto has_name = [&](std::int32_t cell) { return static_cast<std::size_t>(cell) < known; };
    const bool fits = classes && classes->type == CellType::U8 && raw.encoding == codec::CHANGES &&
                      raw.by_class.size() == known * codec::bytes_of(type) &&
                      std::all_of(classes->cells.begin(), classes->cells.end(), has_name);
    require(fits, "by_class", "channel '", raw.channel.name, "' has a class table of ", raw.by_class.size(),
            " bytes; changes, one raw cell for each of ", known, " classes, and their channel before it are needed");
    const Cells table = codec::raw(raw.by_class, type);
    Cells cells;
    for (const std::int32_t cell : classes->cells) cells.push_back(table[static_cast<std::size_t>(cell)]);
    return cells;
}

// Decodes the cells of a channel. `base`: as many cells of the same type, for changes.
inline Cells decode_cells(const RawChannel& raw, std::size_t columns, std::optional<Cells> base) {
    require(raw.cell_count <= CHANNEL_CELLS_MAX, "too_many_cells", raw.cell_count, " cells; at most ",
            CHANNEL_CELLS_MAX, " are allowed");
    require(raw.cell_type >= 1 && raw.cell_type <= 3, "cells", "cell type ", raw.cell_type, "; 1 to 3 are known");
    const auto type = static_cast<CellType>(raw.cell_type);
    const std::size_t length = raw.payload.size(), whole = raw.cell_count * codec::bytes_of(type);
    const codec::Bits bits(raw.payload, type);
    Cells cells;
    if (raw.encoding == codec::RAW && length == whole) {
        cells = codec::raw(raw.payload, type);
    } else if (raw.encoding == codec::ROWS && length < whole) {
        cells = codec::rows(bits, raw.cell_count, columns);
    } else if (raw.encoding == codec::CHANGES && length < whole && base) {
        cells = codec::changes(bits, std::move(*base), columns);
    } else {
        fail("cells", length, " bytes of encoding ", raw.encoding, " for ", whole, " bytes", base ? "" : ", no base");
    }
    const std::uint32_t computed = codec::crc32(cells, type);
    require(computed == raw.crc32, "cells", "CRC-32 of the cells is ", computed, "; the channel states ", raw.crc32);
    return cells;
}

inline std::vector<Class> legend_of(const RawLayer& raw) {
    const std::size_t count = raw.names.size();
    require(raw.meanings.size() == count && raw.colours.size() == count, "legend", count, " names, ",
            raw.meanings.size(), " meanings, ", raw.colours.size(), " colours; equal numbers are needed");
    require(count == 0 || raw.meanings[0] == 0, "legend", "class 0 does not have the meaning 0 (unknown)");
    std::vector<Class> legend;
    for (std::size_t at = 0; at < count; ++at) {
        require(raw.colours[at] <= RGB_MAX, "legend", "a colour of ", raw.colours[at], "; at most ", RGB_MAX);
        // A vehicle does not enter cells of a meaning that this version does not know.
        const bool is_known = raw.meanings[at] >= 0 && raw.meanings[at] <= static_cast<std::int32_t>(Meaning::LOW);
        legend.push_back({raw.names[at], is_known ? static_cast<Meaning>(raw.meanings[at]) : Meaning::UNKNOWN,
                          raw.colours[at]});
    }
    return legend;
}

inline std::vector<SafePoint> points_of(const RawPoints& raw) {
    const auto check = [](bool is_met, std::uint64_t point, const auto&... what) {
        require(is_met, "safe_point", "safe point ", point, ": ", what...);
    };
    const std::size_t count = raw.x.size();
    check(raw.y.size() == count && raw.radius_cm.size() == count && count <= MAP_PARTS_MAX, 0, count,
          " values; as many of each, at most ", MAP_PARTS_MAX, ", are allowed");
    check(std::isfinite(raw.step_m) && raw.step_m > 0, 0, "steps of ", raw.step_m, " m; finite ones over 0 are needed");
    std::vector<SafePoint> points;
    std::int64_t sums[3] = {0, 0, 0};
    for (std::size_t at = 0; at < count; ++at) {
        const std::int64_t differences[3] = {raw.x[at], raw.y[at], raw.radius_cm[at]};
        for (int axis = 0; axis < 3; ++axis) {
            sums[axis] += differences[axis];
            check(std::abs(sums[axis]) <= SAFE_POINT_STEPS_MAX && (axis < 2 || sums[axis] >= 0), at, sums[axis],
                  " steps or cm; to ", SAFE_POINT_STEPS_MAX, " and a radius of 0 or more are allowed");
        }
        points.push_back({static_cast<float>(sums[0]) * raw.step_m, static_cast<float>(sums[1]) * raw.step_m,
                          static_cast<float>(sums[2]) / 100.0f, {}});
        if (at > 0) points.back().links.push_back(static_cast<std::uint32_t>(at - 1));
    }
    std::uint64_t start = 0;
    for (const std::uint32_t ahead : raw.starts) {
        start += ahead;
        check(ahead > 0 && start < count, start, "starts a line; ascending points are needed");
        points[start].links.clear();
    }
    check(raw.link_from.size() == raw.link_back.size(), 0, "links from ", raw.link_from.size(), " points to ",
          raw.link_back.size());
    std::uint64_t from = 0;
    std::uint64_t before = 0;
    for (std::size_t at = 0; at < raw.link_from.size(); ++at) {
        from += raw.link_from[at];
        const std::uint32_t back = raw.link_back[at];
        check(from < count && back >= 2 && back <= from, from, "a link ", back, " points back; 2 to it are allowed");
        const auto to = static_cast<std::uint32_t>(from - back);
        // Points have at most 32 bits; no link is 0, because none starts at the first point.
        const std::uint64_t link = from << 32 | to;
        check(before < link, from, "a link to ", to, " is not ascending");
        before = link;
        // The link to the point before stays last.
        std::vector<std::uint32_t>& links = points[from].links;
        links.insert(std::lower_bound(links.begin(), links.end(), to), to);
    }
    return points;
}

// Checks that the legend has an entry for the class of every cell.
inline void check_classes(const Layer& layer) {
    const Channel* classes = layer.channel("class");
    if (!classes) return;
    const bool begins = !layer.legend.empty() && layer.legend[0].name == "unknown";
    require(begins, "legend", "class 0 is 'unknown' in every legend");
    for (const std::int32_t cell : classes->cells) {
        const bool is_named = cell >= 0 && static_cast<std::size_t>(cell) < layer.legend.size();
        require(is_named, "class", "class ", cell, " has no name among ", layer.legend.size());
    }
}

// Decodes one layer. `base`: its base layer if it is a delta.
inline void decode_layer(RawLayer& raw, const Layer* base) {
    Layer& layer = raw.layer;
    check_grid(layer.grid);
    std::set<std::string_view> names;
    for (const RawChannel& one : raw.channels) {
        require(names.insert(one.channel.name).second, "twice", "channel '", one.channel.name, "' occurs twice");
    }
    const Shift shift = base ? shift_of(base->grid, layer.grid) : Shift{};
    const bool has_legend = !raw.names.empty() || !raw.meanings.empty() || !raw.colours.empty();
    layer.legend = base && !has_legend ? base->legend : legend_of(raw);
    for (RawChannel& one : raw.channels) {
        require(one.cell_count == layer.grid.cell_count(), "cell_count", "channel '", one.channel.name, "' has ",
                one.cell_count, " cells; the grid has ", layer.grid.cell_count());
        std::optional<Cells> from;
        if (!one.by_class.empty()) from = looked_up(one, layer);
        else if (base && one.encoding == codec::CHANGES) from = shifted(one, *base, layer, shift);
        one.channel.cells = decode_cells(one, layer.grid.columns(), std::move(from));
        one.channel.type = static_cast<CellType>(one.cell_type);
        layer.channels.push_back(std::move(one.channel));
    }
    if (raw.points) layer.points = points_of(*raw.points);
    check_classes(layer);
}

// The base layer of a delta; null for a whole layer.
inline const Layer* base_of(const RawLayer& raw, const Header& header, const Map* base) {
    if (!raw.base_sequence) return nullptr;
    const Layer* found = base ? base->find(raw.layer.name) : nullptr;
    const bool is_it = base && base->header.vehicle == header.vehicle && base->header.boot_id == header.boot_id &&
                       base->header.sequence == *raw.base_sequence;
    require(!base || is_it, "other_base", "a delta to map ", *raw.base_sequence, " of '", header.vehicle,
            "'; another one was given");
    require(found, "no_base", "a delta to the layer of map ", *raw.base_sequence);
    return found;
}

}  // namespace clearway::decoding

inline clearway::Map clearway::Map::decode(Bytes bytes, const Map* base) {
    using namespace decoding;
    require(bytes.size() <= MAP_BYTES_MAX, "too_long", "map of ", bytes.size(), " bytes; at most ", MAP_BYTES_MAX,
            " are allowed");
    std::size_t parts = 0;
    count_parts(bytes, true, parts);
    require(parts <= MAP_PARTS_MAX, "too_many_parts", "over ", MAP_PARTS_MAX, " layers, channels, sensors and names");
    Map map;
    bool has_header = false;
    std::vector<RawLayer> layers;
    const auto header = [&](Bytes content) { has_header = true, read_header(content, map.header); };
    const auto layer = [&](Bytes content) { layers.push_back(read_layer(content)); };
    read(bytes, header, layer);
    require(has_header, "header", "the header is absent; every map has one");
    check_header(map.header);
    std::set<std::string_view> names;
    std::uint64_t cells = 0;
    for (const RawLayer& raw : layers) {
        require(names.insert(raw.layer.name).second, "twice", "layer '", raw.layer.name, "' occurs twice");
        for (const RawChannel& channel : raw.channels) cells += channel.cell_count;
    }
    require(cells <= MAP_CELLS_MAX, "too_many_cells", "the channels claim ", cells, " cells; at most ", MAP_CELLS_MAX,
            " are allowed");
    for (RawLayer& raw : layers) {
        try {
            decode_layer(raw, base_of(raw, map.header, base));
        } catch (const Error& error) {
            fail(error.reason(), "layer '", raw.layer.name, "': ", error.what());
        }
        map.layers.push_back(std::move(raw.layer));
    }
    return map;
}
