// The layers of a map from their messages: legends, channels, safe points, and the checks between them.
#pragma once

#include "decode.hpp"

namespace clearway {
namespace decoding {

inline std::vector<Class> legend_of(const RawLayer& raw) {
    const auto check = [&](bool is_met, const auto&... what) {
        require(is_met, "legend", "layer '", raw.layer.name, "': ", what...);
    };
    const std::size_t count = raw.names.size();
    check(raw.meanings.size() == count && raw.colours.size() == count, count, " names, ", raw.meanings.size(),
          " meanings, ", raw.colours.size(), " colours; equal numbers are needed");
    check(count == 0 || raw.meanings[0] == 0, "class 0 does not have the meaning 0 (unknown)");
    std::vector<Class> legend;
    for (std::size_t at = 0; at < count; ++at) {
        check(raw.colours[at] <= RGB_MAX, "a colour of ", raw.colours[at], "; at most ", RGB_MAX, " is allowed");
        // A vehicle does not enter cells of a meaning that this version does not know.
        const bool is_known = raw.meanings[at] >= 0 && raw.meanings[at] <= static_cast<std::int32_t>(Meaning::LOW);
        legend.push_back({raw.names[at], is_known ? static_cast<Meaning>(raw.meanings[at]) : Meaning::UNKNOWN,
                          raw.colours[at]});
    }
    return legend;
}

inline std::vector<SafePoint> points_of(const std::string& layer, const RawPoints& raw) {
    const auto check = [&](bool is_met, std::uint64_t point, const auto&... what) {
        require(is_met, "safe_point", "layer '", layer, "', safe point ", point, ": ", what...);
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
    std::optional<std::pair<std::uint64_t, std::uint64_t>> before;
    for (std::size_t at = 0; at < raw.link_from.size(); ++at) {
        from += raw.link_from[at];
        const std::uint32_t back = raw.link_back[at];
        check(from < count && back >= 2 && back <= from, from, "a link ", back, " points back; 2 to it are allowed");
        const std::pair<std::uint64_t, std::uint64_t> link{from, from - back};
        check(!before || *before < link, from, "a link to ", link.second, " is not ascending");
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
    require(!layer.legend.empty() && layer.legend[0].name == "unknown", "legend", "layer '", layer.name,
            "': class 0 is 'unknown' in every legend");
    for (const std::int32_t cell : classes->cells) {
        require(cell >= 0 && static_cast<std::size_t>(cell) < layer.legend.size(), "class", "layer '", layer.name,
                "': class ", cell, " has no name among ", layer.legend.size());
    }
}

template <class List, class Name>
void check_unique(const char* what, const List& list, Name name_of) {
    std::set<std::string_view> names;
    for (const auto& item : list) {
        require(names.insert(name_of(item)).second, "twice", what, " '", name_of(item), "' occurs twice");
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
        require(one.cell_count == layer.grid.cell_count(), "cell_count", "channel '", one.channel.name, "' has ",
                one.cell_count, " cells; the grid has ", layer.grid.cell_count());
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
    const Layer* found = base ? base->find(raw.layer.name) : nullptr;
    const bool is_it = base && base->header.vehicle == header.vehicle && base->header.boot_id == header.boot_id &&
                       base->header.sequence == *raw.base_sequence;
    require(!base || is_it, "other_base", "layer '", raw.layer.name, "' is a delta to map ", *raw.base_sequence, " of '",
            header.vehicle, "'; another one was given");
    require(found, "no_base", "layer '", raw.layer.name, "' is a delta to the layer of map ", *raw.base_sequence);
    return found;
}

}  // namespace decoding

inline Map Map::decode(Bytes bytes, const Map* base) {
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
    check_unique("layer", layers, [](const RawLayer& raw) -> const std::string& { return raw.layer.name; });
    std::uint64_t cells = 0;
    for (const RawLayer& raw : layers) {
        for (const RawChannel& channel : raw.channels) cells += channel.cell_count;
    }
    require(cells <= MAP_CELLS_MAX, "too_many_cells", "the channels claim ", cells, " cells; at most ", MAP_CELLS_MAX,
            " are allowed");
    for (RawLayer& raw : layers) {
        const Layer* before = base_of(raw, map.header, base);
        map.layers.push_back(decode_layer(std::move(raw), before));
    }
    return map;
}

}  // namespace clearway
