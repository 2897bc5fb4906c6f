// The bytes of a map -> `Map`, with the checks of `proto/src/map/decode.rs` in the same order.
#pragma once

#include <set>

#include "map.hpp"

namespace clearway {
namespace decoding {

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

// A layer as on the wire.
struct RawLayer {
    Layer layer;
    std::variant<std::monostate, RadialGrid, CartesianGrid> geometry;
    std::vector<std::string> names;
    std::vector<std::int32_t> meanings;
    std::vector<std::uint32_t> colours;
    std::vector<RawChannel> channels;
    std::optional<RawPoints> points;
    std::optional<std::uint64_t> base_sequence;
};

using wire::Fields;
using wire::fixed;
using wire::read;
using wire::Unread;
using wire::zigzag;

// Counts layers, channels, planes, sensors and names, up to the first byte that is not protobuf; stops above the limit.
inline void count_parts(Bytes message, bool is_map, std::size_t& parts) {
    try {
        for (Fields fields(message); parts <= MAP_PARTS_MAX && fields.next();) {
            if (!fields.has_content()) continue;
            ++parts;
            if (is_map && fields.tag() <= 2) count_parts(fields.content(), false, parts);
        }
    } catch (const Error&) {
        // The decoder stops there too, and names the fault.
    }
}

inline void read_header(Bytes message, Header& h) {
    const auto pose = [&](Bytes content) {
        if (!h.map_from_ego) h.map_from_ego.emplace();
        Pose& p = *h.map_from_ego;
        read(content, p.x, p.y, p.z, p.qx, p.qy, p.qz, p.qw);
    };
    const Unread other;
    read(message, h.vehicle, fixed(h.boot_id), h.sequence, fixed(h.capture_start_ns), fixed(h.capture_end_ns),
         fixed(h.completed_ns), fixed(h.valid_until_ns), pose, h.speed_mps, other, other, other, other, h.epoch, other,
         h.wire_version);
}

// The alternative of a `oneof`, as it is or made now.
template <class Kind, class Variant>
Kind& kept(Variant& geometry) {
    return std::holds_alternative<Kind>(geometry) ? std::get<Kind>(geometry) : geometry.template emplace<Kind>();
}

inline RawLayer read_layer(Bytes message) {
    RawLayer raw;
    const auto radial = [&](Bytes content) {
        auto& grid = kept<RadialGrid>(raw.geometry);
        read(content, grid.row_radius_m, grid.columns, grid.centre_x_m, grid.centre_y_m);
    };
    const auto cartesian = [&](Bytes content) {
        auto& grid = kept<CartesianGrid>(raw.geometry);
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
        if (!raw.points) raw.points.emplace();
        RawPoints& of = *raw.points;
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

inline Grid checked_grid(const RawLayer& raw) {
    const auto check = [&](bool is_met, const auto&... what) {
        require(is_met, "geometry", "layer '", raw.layer.name, "': ", what...);
    };
    if (const auto* grid = std::get_if<RadialGrid>(&raw.geometry)) {
        float inner = 0;
        for (const float outer : grid->row_radius_m) {
            check(std::isfinite(outer) && outer > inner, "a radius of ", outer, " m; finite, ascending ones are needed");
            inner = outer;
        }
        check(grid->columns > 0 && !grid->row_radius_m.empty(), "0 cells; at least 1 is needed");
        check(std::isfinite(grid->centre_x_m) && std::isfinite(grid->centre_y_m), "a centre that is not finite");
        return *grid;
    }
    const auto* grid = std::get_if<CartesianGrid>(&raw.geometry);
    check(grid, "no grid; radial or cartesian is needed");
    check(grid->width > 0 && grid->height > 0, "0 cells; at least 1 is needed");
    check(std::isfinite(grid->cell_m) && grid->cell_m > 0, "cells of ", grid->cell_m, " m; finite edges are needed");
    check(std::isfinite(grid->origin_x_m) && std::isfinite(grid->origin_y_m) && std::isfinite(grid->yaw_rad),
          "an origin or a yaw that is not finite");
    return *grid;
}

// Rows and columns from the cells of a grid to the cells of its base layer at the same places; none if they share none.
struct Shift {
    std::optional<std::int64_t> rows = 0, columns = 0;
};

inline Shift shift_of(const Layer& base, const Layer& layer) {
    const RadialGrid *before = base.grid.radial(), *now = layer.grid.radial();
    const CartesianGrid *squares = base.grid.cartesian(), *moved = layer.grid.cartesian();
    const bool is_same = before && now ? before->row_radius_m == now->row_radius_m && before->columns == now->columns &&
                                             before->centre_x_m == now->centre_x_m &&
                                             before->centre_y_m == now->centre_y_m
                                       : squares && moved && squares->cell_m == moved->cell_m;
    require(is_same, "base_shape", "layer '", layer.name, "' is a delta to a grid that is not comparable");
    if (now) return {};
    const auto steps = [](std::int64_t to, std::int64_t from) -> std::optional<std::int64_t> {
        // The difference of any two numbers fits in 64 bits without its sign.
        const auto far = to >= from ? static_cast<std::uint64_t>(to) - static_cast<std::uint64_t>(from)
                                    : static_cast<std::uint64_t>(from) - static_cast<std::uint64_t>(to);
        if (far > UINT32_MAX) return std::nullopt;
        return to >= from ? static_cast<std::int64_t>(far) : -static_cast<std::int64_t>(far);
    };
    return {steps(moved->first_iy, squares->first_iy), steps(moved->first_ix, squares->first_ix)};
}

// The base of a delta's channel: the base layer's cells at the places of the grid, `unknown` where it has none.
inline Cells shifted(const RawChannel& raw, const Layer& base, const Layer& layer, const Shift& by) {
    const Channel* before = base.channel(raw.channel.name);
    require(before && static_cast<std::int32_t>(before->type) == raw.cell_type, "base_shape", "layer '", layer.name,
            "': the base has no channel '", raw.channel.name, "' of cell type ", raw.cell_type);
    Cells cells(raw.cell_count, codec::wrapped(before->type, static_cast<std::uint32_t>(raw.channel.unknown)));
    if (!by.rows || !by.columns) return cells;
    const auto signed_size = [](std::size_t size) { return static_cast<std::int64_t>(size); };
    const auto rows = signed_size(layer.grid.rows()), columns = signed_size(layer.grid.columns());
    const auto from_rows = signed_size(base.grid.rows()), from_columns = signed_size(base.grid.columns());
    const auto first = std::max<std::int64_t>(0, -*by.columns), last = std::min(columns, from_columns - *by.columns);
    for (std::int64_t row = 0; row < rows && first < last; ++row) {
        const std::int64_t from = row + *by.rows;
        if (from < 0 || from >= from_rows) continue;
        std::copy_n(before->cells.begin() + from * from_columns + first + *by.columns, last - first,
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
    codec::check(raw.cell_type >= 1 && raw.cell_type <= 3, "cell type ", raw.cell_type, "; 1 to 3 are known");
    const auto type = static_cast<CellType>(raw.cell_type);
    const std::size_t length = raw.payload.size(), whole = raw.cell_count * codec::bytes_of(type);
    const bool fits = raw.encoding == codec::RAW       ? length == whole
                      : raw.encoding == codec::ROWS    ? length < whole
                      : raw.encoding == codec::CHANGES ? length < whole && base
                                                       : false;
    codec::check(fits, length, " bytes of encoding ", raw.encoding, " for ", raw.cell_count, " cells",
                 base ? "" : " without a base");
    const codec::Bits bits(raw.payload, type);
    const Cells cells = raw.encoding == codec::RAW    ? codec::raw(raw.payload, type)
                        : raw.encoding == codec::ROWS ? codec::rows(bits, raw.cell_count, columns)
                                                      : codec::changes(bits, std::move(*base), columns);
    const std::uint32_t computed = codec::crc32(cells, type);
    codec::check(computed == raw.crc32, "CRC-32 of the cells is ", computed, "; the channel states ", raw.crc32);
    return cells;
}

inline void check_count(const RawChannel& raw) {
    require(raw.cell_count <= CHANNEL_CELLS_MAX, "too_many_cells", raw.cell_count, " cells; at most ",
            CHANNEL_CELLS_MAX, " are allowed");
}

}  // namespace decoding
}  // namespace clearway

#include "layers.hpp"
