// The layers of a map from their messages: legends, channels, safe points, and the checks between them.
#pragma once

#include "decode.hpp"

namespace clearway {
namespace decoding {

inline std::vector<Class> legend_of(const RawLayer& raw) {
    const auto wrong = [&](const std::string& what) {
        return Error("legend", "layer '" + raw.layer.name + "': " + what);
    };
    const std::size_t count = raw.names.size();
    if (raw.meanings.size() != count || raw.colours.size() != count) {
        throw wrong(std::to_string(count) + " names, " + std::to_string(raw.meanings.size()) + " meanings, " +
                    std::to_string(raw.colours.size()) + " colours; equal numbers are needed");
    }
    if (count > 0 && raw.meanings[0] != 0) {
        throw wrong("class 0 has the meaning " + std::to_string(raw.meanings[0]) + "; 0 (unknown) is needed");
    }
    std::vector<Class> legend;
    for (std::size_t at = 0; at < count; ++at) {
        if (raw.colours[at] > RGB_MAX) throw wrong("a colour of " + std::to_string(raw.colours[at]));
        // A vehicle does not enter cells of a meaning that this version does not know.
        const bool is_known = raw.meanings[at] >= 0 && raw.meanings[at] <= static_cast<std::int32_t>(Meaning::LOW);
        legend.push_back({raw.names[at], is_known ? static_cast<Meaning>(raw.meanings[at]) : Meaning::UNKNOWN,
                          raw.colours[at]});
    }
    return legend;
}

inline std::vector<SafePoint> points_of(const std::string& layer, const RawPoints& raw) {
    const auto wrong = [&](std::size_t point, const std::string& what) {
        return Error("safe_point", "layer '" + layer + "', safe point " + std::to_string(point) + ": " + what);
    };
    const std::size_t count = raw.x.size();
    if (raw.y.size() != count || raw.radius_cm.size() != count || count > MAP_PARTS_MAX) {
        throw wrong(0, std::to_string(count) + " values; as many of each, at most " + std::to_string(MAP_PARTS_MAX) +
                           ", are allowed");
    }
    if (!std::isfinite(raw.step_m) || raw.step_m <= 0) {
        throw wrong(0, "steps of " + std::to_string(raw.step_m) + " m; finite metres over 0 are needed");
    }
    std::vector<SafePoint> points;
    std::int64_t sums[3] = {0, 0, 0};
    for (std::size_t at = 0; at < count; ++at) {
        const std::int64_t differences[3] = {raw.x[at], raw.y[at], raw.radius_cm[at]};
        for (int axis = 0; axis < 3; ++axis) {
            sums[axis] += differences[axis];
            if (std::abs(sums[axis]) > SAFE_POINT_STEPS_MAX || (axis == 2 && sums[axis] < 0)) {
                throw wrong(at, std::to_string(sums[axis]) + " steps or cm; to " +
                                    std::to_string(SAFE_POINT_STEPS_MAX) + " and a radius of 0 or more are allowed");
            }
        }
        SafePoint point{static_cast<float>(sums[0]) * raw.step_m, static_cast<float>(sums[1]) * raw.step_m,
                        static_cast<float>(sums[2]) / 100.0f, {}};
        if (at > 0) point.links.push_back(static_cast<std::uint32_t>(at - 1));
        points.push_back(std::move(point));
    }
    std::uint64_t start = 0;
    for (const std::uint32_t ahead : raw.starts) {
        start += ahead;
        if (ahead == 0 || start >= count) throw wrong(start, "starts a line; ascending points are needed");
        points[start].links.clear();
    }
    if (raw.link_from.size() != raw.link_back.size()) {
        throw wrong(0, "links from " + std::to_string(raw.link_from.size()) + " points to " +
                           std::to_string(raw.link_back.size()));
    }
    std::uint64_t from = 0;
    std::optional<std::pair<std::uint64_t, std::uint64_t>> before;
    for (std::size_t at = 0; at < raw.link_from.size(); ++at) {
        from += raw.link_from[at];
        const std::uint32_t back = raw.link_back[at];
        if (from >= count || back < 2 || back > from) {
            throw wrong(from, "a link " + std::to_string(back) + " points back; 2 or more, to a point, are needed");
        }
        const std::pair<std::uint64_t, std::uint64_t> link{from, from - back};
        if (before && *before >= link) throw wrong(from, "a link to " + std::to_string(link.second) + " not ascending");
        before = link;
        // The link to the point before stays last.
        std::vector<std::uint32_t>& links = points[from].links;
        const auto to = static_cast<std::uint32_t>(link.second);
        links.insert(std::lower_bound(links.begin(), links.end(), to), to);
    }
    return points;
}

// Checks that the legend has an entry for the class of every cell.
inline void check_classes(const Layer& layer) {
    const Channel* classes = layer.channel("class");
    if (!classes) return;
    if (layer.legend.empty() || layer.legend[0].name != "unknown") {
        throw Error("legend", "layer '" + layer.name + "': class 0 is 'unknown' in every legend");
    }
    for (const std::int32_t cell : classes->cells) {
        if (cell < 0 || static_cast<std::size_t>(cell) >= layer.legend.size()) {
            throw Error("class", "layer '" + layer.name + "': class " + std::to_string(cell) + " has no name among " +
                                     std::to_string(layer.legend.size()));
        }
    }
}

template <class List, class Name>
void check_unique(const std::string& what, const List& list, Name name_of) {
    std::set<std::string_view> names;
    for (const auto& item : list) {
        if (!names.insert(name_of(item)).second) {
            throw Error("twice", what + " '" + name_of(item) + "' occurs twice; names are unique");
        }
    }
}

// Decodes one layer. `base`: its base layer if it is a delta.
inline Layer decode_layer(RawLayer raw, const Layer* base) {
    Layer layer = std::move(raw.layer);
    raw.layer.name = layer.name;
    layer.grid = checked_grid(raw);
    check_unique("channel", raw.channels, [](const RawChannel& one) -> const std::string& { return one.channel.name; });
    const Shift shift = base ? shift_of(*base, layer) : Shift{};
    const bool has_legend = !raw.names.empty() || !raw.meanings.empty() || !raw.colours.empty();
    layer.legend = base && !has_legend ? base->legend : legend_of(raw);
    for (RawChannel& one : raw.channels) {
        if (one.cell_count != layer.grid.cell_count()) {
            throw Error("cell_count", "channel '" + one.channel.name + "' has " + std::to_string(one.cell_count) +
                                          " cells; the grid has " + std::to_string(layer.grid.cell_count()));
        }
        check_count(one);
        std::optional<Cells> from;
        if (!one.by_class.empty()) {
            from = looked_up(one, layer);
        } else if (base && one.encoding == codec::CHANGES) {
            from = shifted(one, *base, layer, shift);
        }
        one.channel.cells = decode_cells(one, layer.grid.columns(), std::move(from));
        one.channel.type = static_cast<CellType>(one.cell_type);
        layer.channels.push_back(std::move(one.channel));
    }
    if (raw.points) layer.points = points_of(layer.name, *raw.points);
    check_classes(layer);
    return layer;
}

// The base layer of a delta; null for a whole layer.
inline const Layer* base_of(const RawLayer& raw, const Header& header, const Map* base) {
    if (!raw.base_sequence) return nullptr;
    const std::string needed = std::to_string(*raw.base_sequence);
    const auto missing = [&] {
        return Error("no_base", "layer '" + raw.layer.name + "' is a delta to the layer of map " + needed);
    };
    if (!base) throw missing();
    const Header& given = base->header;
    if (given.vehicle != header.vehicle || given.boot_id != header.boot_id || given.sequence != *raw.base_sequence) {
        throw Error("other_base", "layer '" + raw.layer.name + "' is a delta to map " + needed + " of '" +
                                      header.vehicle + "'; map " + std::to_string(given.sequence) + " of '" +
                                      given.vehicle + "' was given");
    }
    if (const Layer* found = base->find(raw.layer.name)) return found;
    throw missing();
}

}  // namespace decoding

inline Map Map::decode(Bytes bytes, const Map* base) {
    using namespace decoding;
    if (bytes.size() > MAP_BYTES_MAX) {
        throw Error("too_long", "map of " + std::to_string(bytes.size()) + " bytes; at most " +
                                    std::to_string(MAP_BYTES_MAX) + " are allowed");
    }
    std::size_t parts = 0;
    count_parts(bytes, true, parts);
    if (parts > MAP_PARTS_MAX) {
        throw Error("too_many_parts", "over " + std::to_string(MAP_PARTS_MAX) + " layers, channels, sensors and names");
    }
    std::optional<Header> header;
    std::vector<RawLayer> layers;
    for (Fields fields(bytes); fields.next();) {
        if (fields.tag() == 1) {
            if (!header) header.emplace();
            read_header(fields.content(), *header);
        } else if (fields.tag() == 2) {
            layers.push_back(read_layer(fields.content()));
        }
    }
    if (!header) throw Error("header", "the header is absent; every map has one");
    check_header(*header);
    check_unique("layer", layers, [](const RawLayer& raw) -> const std::string& { return raw.layer.name; });
    std::uint64_t cells = 0;
    for (const RawLayer& raw : layers) {
        for (const RawChannel& channel : raw.channels) cells += channel.cell_count;
    }
    if (cells > MAP_CELLS_MAX) {
        throw Error("too_many_cells", "the channels claim " + std::to_string(cells) + " cells; at most " +
                                          std::to_string(MAP_CELLS_MAX) + " are allowed");
    }
    Map map;
    map.header = std::move(*header);
    for (RawLayer& raw : layers) {
        const Layer* before = base_of(raw, map.header, base);
        map.layers.push_back(decode_layer(std::move(raw), before));
    }
    return map;
}

}  // namespace clearway
