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

inline void read_header(Bytes message, Header& header) {
    for (Fields fields(message); fields.next();) {
        switch (fields.tag()) {
            case 1: header.vehicle = fields.text(); break;
            case 2: header.boot_id = fields.fixed64(); break;
            case 3: header.sequence = fields.varint(); break;
            case 4: header.capture_start_ns = fields.sfixed64(); break;
            case 5: header.capture_end_ns = fields.sfixed64(); break;
            case 6: header.completed_ns = fields.sfixed64(); break;
            case 7: header.valid_until_ns = fields.sfixed64(); break;
            case 8: {
                if (!header.map_from_ego) header.map_from_ego.emplace();
                Pose& pose = *header.map_from_ego;
                double* const values[] = {&pose.x, &pose.y, &pose.z, &pose.qx, &pose.qy, &pose.qz, &pose.qw};
                for (Fields of(fields.content()); of.next();) {
                    if (of.tag() <= 7) *values[of.tag() - 1] = of.f64();
                }
                break;
            }
            case 9: header.speed_mps = fields.f64(); break;
            case 14: header.epoch = fields.u32(); break;
            case 16: header.wire_version = fields.u32(); break;
            default: break;
        }
    }
}

inline void read_radial(Bytes message, RadialGrid& grid) {
    for (Fields fields(message); fields.next();) {
        switch (fields.tag()) {
            case 1: fields.append(grid.row_radius_m, Fields::FIXED32, &Fields::f32); break;
            case 2: grid.columns = fields.u32(); break;
            case 3: grid.centre_x_m = fields.f32(); break;
            case 4: grid.centre_y_m = fields.f32(); break;
            default: break;
        }
    }
}

inline void read_cartesian(Bytes message, CartesianGrid& grid) {
    for (Fields fields(message); fields.next();) {
        switch (fields.tag()) {
            case 1: grid.origin_x_m = fields.f64(); break;
            case 2: grid.origin_y_m = fields.f64(); break;
            case 3: grid.width = fields.u32(); break;
            case 4: grid.height = fields.u32(); break;
            case 5: grid.cell_m = fields.f32(); break;
            case 6: grid.yaw_rad = fields.f64(); break;
            case 7: grid.first_ix = fields.s64(); break;
            case 8: grid.first_iy = fields.s64(); break;
            default: break;
        }
    }
}

inline RawChannel read_channel(Bytes message) {
    RawChannel raw;
    for (Fields fields(message); fields.next();) {
        switch (fields.tag()) {
            case 1: raw.channel.name = fields.text(); break;
            case 2: raw.channel.unit = fields.text(); break;
            case 3: raw.channel.scale = fields.f32(); break;
            case 4: raw.cell_type = fields.i32(); break;
            case 5: raw.channel.unknown = fields.s32(); break;
            case 6: raw.encoding = fields.i32(); break;
            case 7: raw.cell_count = fields.u32(); break;
            case 8: raw.crc32 = fields.fixed32(); break;
            case 9: raw.payload = fields.content(); break;
            case 10: raw.by_class = fields.content(); break;
            default: break;
        }
    }
    return raw;
}

inline void read_points(Bytes message, RawPoints& points) {
    for (Fields fields(message); fields.next();) {
        switch (fields.tag()) {
            case 1: points.step_m = fields.f32(); break;
            case 2: fields.append(points.x, Fields::VARINT, &Fields::s32); break;
            case 3: fields.append(points.y, Fields::VARINT, &Fields::s32); break;
            case 4: fields.append(points.radius_cm, Fields::VARINT, &Fields::s32); break;
            case 5: fields.append(points.starts, Fields::VARINT, &Fields::u32); break;
            case 6: fields.append(points.link_from, Fields::VARINT, &Fields::u32); break;
            case 7: fields.append(points.link_back, Fields::VARINT, &Fields::u32); break;
            default: break;
        }
    }
}

template <class Kind, class Variant>
Kind& kept(Variant& geometry) {
    return std::holds_alternative<Kind>(geometry) ? std::get<Kind>(geometry) : geometry.template emplace<Kind>();
}

inline RawLayer read_layer(Bytes message) {
    RawLayer raw;
    for (Fields fields(message); fields.next();) {
        switch (fields.tag()) {
            case 1: raw.layer.name = fields.text(); break;
            case 2: read_radial(fields.content(), kept<RadialGrid>(raw.geometry)); break;
            case 3: read_cartesian(fields.content(), kept<CartesianGrid>(raw.geometry)); break;
            case 4: raw.names.push_back(fields.text()); break;
            case 5: raw.channels.push_back(read_channel(fields.content())); break;
            case 6: {
                double values[3] = {0, 0, 0};
                for (Fields of(fields.content()); of.next();) {
                    if (of.tag() <= 3) values[of.tag() - 1] = of.f64();
                }
                raw.layer.planes.push_back({values[0], values[1], values[2]});
                break;
            }
            case 7: {
                std::pair<std::string, double> metric;
                for (Fields of(fields.content()); of.next();) {
                    if (of.tag() == 1) metric.first = of.text();
                    if (of.tag() == 2) metric.second = of.f64();
                }
                raw.layer.metrics[metric.first] = metric.second;
                break;
            }
            case 9:
                if (!raw.points) raw.points.emplace();
                read_points(fields.content(), *raw.points);
                break;
            case 10: raw.base_sequence = fields.varint(); break;
            case 11: fields.append(raw.meanings, Fields::VARINT, &Fields::i32); break;
            case 12: fields.append(raw.colours, Fields::FIXED32, &Fields::fixed32); break;
            default: break;
        }
    }
    return raw;
}

inline void check_header(const Header& header) {
    if (header.wire_version > WIRE_VERSION) {
        throw Error("version", "wire of version " + std::to_string(header.wire_version) +
                                   "; this reader knows versions up to " + std::to_string(WIRE_VERSION));
    }
    if (header.capture_start_ns > header.capture_end_ns) {
        throw Error("header", "capture starts at " + std::to_string(header.capture_start_ns) +
                                  " ns; that is after its end at " + std::to_string(header.capture_end_ns) + " ns");
    }
    if (!header.map_from_ego) return;
    const Pose& p = *header.map_from_ego;
    const double norm = std::sqrt(p.qx * p.qx + p.qy * p.qy + p.qz * p.qz + p.qw * p.qw);
    const bool is_finite = std::isfinite(p.x) && std::isfinite(p.y) && std::isfinite(p.z) && std::isfinite(norm);
    if (!is_finite || std::abs(norm - 1.0) > 1e-3) {
        throw Error("header", "map_from_ego has a quaternion of norm " + std::to_string(norm) +
                                  "; finite metres and norm 1 are needed");
    }
}

inline Grid checked_grid(const RawLayer& raw) {
    const auto wrong = [&](const std::string& what) {
        return Error("geometry", "layer '" + raw.layer.name + "': " + what);
    };
    if (const auto* grid = std::get_if<RadialGrid>(&raw.geometry)) {
        float inner = 0;
        for (const float outer : grid->row_radius_m) {
            if (!std::isfinite(outer) || outer <= inner) {
                throw wrong("a radius of " + std::to_string(outer) + " m; finite, ascending radii are needed");
            }
            inner = outer;
        }
        if (grid->columns == 0 || grid->row_radius_m.empty()) throw wrong("0 cells; at least 1 is needed");
        if (!std::isfinite(grid->centre_x_m) || !std::isfinite(grid->centre_y_m)) throw wrong("a centre not finite");
        return *grid;
    }
    const auto* grid = std::get_if<CartesianGrid>(&raw.geometry);
    if (!grid) throw wrong("no grid; radial or cartesian is needed");
    if (grid->width == 0 || grid->height == 0) throw wrong("0 cells; at least 1 is needed");
    if (!std::isfinite(grid->cell_m) || grid->cell_m <= 0) {
        throw wrong("cells of " + std::to_string(grid->cell_m) + " m; a finite edge above 0 is needed");
    }
    if (!std::isfinite(grid->origin_x_m) || !std::isfinite(grid->origin_y_m) || !std::isfinite(grid->yaw_rad)) {
        throw wrong("an origin or a yaw that is not finite");
    }
    return *grid;
}

// Rows and columns from the cells of a grid to the cells of its base layer at the same places; none if they share none.
struct Shift {
    std::optional<std::int64_t> rows = 0, columns = 0;
};

inline Shift shift_of(const Layer& base, const Layer& layer) {
    const auto wrong = [&] {
        return Error("base_shape", "layer '" + layer.name + "' is a delta to a grid that is not comparable");
    };
    if (const RadialGrid *before = base.grid.radial(), *now = layer.grid.radial(); before && now) {
        const bool is_same = before->row_radius_m == now->row_radius_m && before->columns == now->columns &&
                             before->centre_x_m == now->centre_x_m && before->centre_y_m == now->centre_y_m;
        if (!is_same) throw wrong();
        return {};
    }
    const CartesianGrid *before = base.grid.cartesian(), *now = layer.grid.cartesian();
    if (!before || !now || before->cell_m != now->cell_m) throw wrong();
    const auto steps = [](std::int64_t to, std::int64_t from) -> std::optional<std::int64_t> {
        // The difference of any two numbers fits in 64 bits without its sign.
        const auto far = to >= from ? static_cast<std::uint64_t>(to) - static_cast<std::uint64_t>(from)
                                    : static_cast<std::uint64_t>(from) - static_cast<std::uint64_t>(to);
        if (far > UINT32_MAX) return std::nullopt;
        return to >= from ? static_cast<std::int64_t>(far) : -static_cast<std::int64_t>(far);
    };
    return {steps(now->first_iy, before->first_iy), steps(now->first_ix, before->first_ix)};
}

// The base of a delta's channel: the base layer's cells at the places of the grid, `unknown` where it has none.
inline Cells shifted(const RawChannel& raw, const Layer& base, const Layer& layer, const Shift& by) {
    const Channel* before = base.channel(raw.channel.name);
    if (!before || static_cast<std::int32_t>(before->type) != raw.cell_type) {
        throw Error("base_shape", "layer '" + layer.name + "': the base has no channel '" + raw.channel.name +
                                      "' of cell type " + std::to_string(raw.cell_type));
    }
    const auto unknown = codec::wrapped(before->type, static_cast<std::uint32_t>(raw.channel.unknown));
    Cells cells(raw.cell_count, unknown);
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
    const bool fits = classes && classes->type == CellType::U8 && raw.encoding == codec::CHANGES &&
                      raw.by_class.size() == known * codec::bytes_of(type);
    const auto has_name = [&](std::int32_t cell) { return static_cast<std::size_t>(cell) < known; };
    if (!fits || !std::all_of(classes->cells.begin(), classes->cells.end(), has_name)) {
        throw Error("by_class", "channel '" + raw.channel.name + "' has a class table of " +
                                    std::to_string(raw.by_class.size()) + " bytes; changes, one raw cell for each of " +
                                    std::to_string(known) + " classes, and their channel before it are needed");
    }
    const Cells table = codec::raw(raw.by_class, type);
    Cells cells(classes->cells.size());
    const auto look_up = [&](std::int32_t cell) { return table[static_cast<std::size_t>(cell)]; };
    std::transform(classes->cells.begin(), classes->cells.end(), cells.begin(), look_up);
    return cells;
}

// Decodes the cells of a channel. `base`: as many cells of the same type, for changes.
inline Cells decode_cells(const RawChannel& raw, std::size_t columns, std::optional<Cells> base) {
    if (raw.cell_type < 1 || raw.cell_type > 3) codec::refuse("cell type " + std::to_string(raw.cell_type));
    const auto type = static_cast<CellType>(raw.cell_type);
    const std::size_t length = raw.payload.size(), whole = raw.cell_count * codec::bytes_of(type);
    const bool fits = raw.encoding == codec::RAW       ? length == whole
                      : raw.encoding == codec::ROWS    ? length < whole
                      : raw.encoding == codec::CHANGES ? length < whole && base
                                                       : false;
    if (!fits) {
        codec::refuse(std::to_string(length) + " bytes of encoding " + std::to_string(raw.encoding) + " for " +
                      std::to_string(raw.cell_count) + " cells" + (base ? "" : " without a base"));
    }
    const codec::Bits bits(raw.payload, type);
    const Cells cells = raw.encoding == codec::RAW    ? codec::raw(raw.payload, type)
                        : raw.encoding == codec::ROWS ? codec::rows(bits, raw.cell_count, columns)
                                                      : codec::changes(bits, std::move(*base), columns);
    if (const auto computed = codec::crc32(cells, type); computed != raw.crc32) {
        codec::refuse("CRC-32 of the cells is " + std::to_string(computed) + "; the channel states " +
                      std::to_string(raw.crc32));
    }
    return cells;
}

inline void check_count(const RawChannel& raw) {
    if (raw.cell_count <= CHANNEL_CELLS_MAX) return;
    throw Error("too_many_cells", std::to_string(raw.cell_count) + " cells; at most " +
                                      std::to_string(CHANNEL_CELLS_MAX) + " are allowed");
}

}  // namespace decoding
}  // namespace clearway

#include "layers.hpp"
