// Questions of a planner to one layer: whether an area or a path is free, what blocks it, what is nearest, and how far
// the next cell is that is not free.
//
// In: a layer with classes, and a polygon, a path or a point in the ego frame (x forward, y left, metres). Out: answers
// from the meanings in the layer's legend; they consider every cell that an area touches, its border included. Only
// FREE is free; ground outside the grid is not free. A low thing, which some vehicles clear, has an answer of its own.
// The Rust and the Python client give the same answers (`client/golden/questions.json`).
#pragma once

#include "map.hpp"
#include "touched.hpp"

namespace clearway {

// A cell that is not free.
struct Blocker {
    // Centre of the cell; of a place outside the grid, that place.
    Point at;
    // Name of its class; `unknown` outside the grid.
    std::string name;
    // Why the cell has its class, if the map says it; `outside of the map` outside the grid.
    std::optional<std::string> why;
};

// What a vehicle may do on an area: drive there; drive there if it clears low things; not drive there.
enum class Verdict { FREE, LOW, BLOCKED };

struct Answer {
    Verdict verdict = Verdict::BLOCKED;
    // The cell nearest to the ego origin that forbids it; none if the area is free.
    std::optional<Blocker> blocker;
};

// A cell that is not free, and the distance along the path at which the vehicle touches it, in metres.
struct Met {
    double along_m = 0;
    Blocker blocker;
};

// What a vehicle meets on a path.
struct Along {
    double length_m = 0;
    // The first low thing; none behind the first cell that blocks.
    std::optional<Met> low;
    // The first cell that blocks.
    std::optional<Met> blocked;
};

// The nearest point of a cell that contains an obstacle.
struct Obstacle {
    Point at;
    // Distance from the given point, in metres. No obstacle of the layer is nearer; the obstacle itself can be farther
    // away by up to the size of the cell.
    double distance_m = 0;
    // Name of the cell's class.
    std::string name;
};

namespace asking {

inline Verdict verdict_of(const Class* found) {
    if (!found) return Verdict::BLOCKED;
    return found->meaning == Meaning::FREE  ? Verdict::FREE
           : found->meaning == Meaning::LOW ? Verdict::LOW
                                            : Verdict::BLOCKED;
}

inline std::optional<std::string> why_of(const Layer& layer, std::size_t cell) {
    static constexpr const char* REASONS[] = {"not seen", "seen",     "bridged", "remembered", "step",
                                              "obstacle", "overhang", "ditch",   "too narrow"};
    const Channel* why = layer.channel("why");
    if (!why || cell >= why->cells.size()) return std::nullopt;
    const std::int32_t raw = why->cells[cell];
    return raw >= 0 && raw < 9 ? std::string(REASONS[raw]) : "reason " + std::to_string(raw);
}

// The answer for checked corners; of several cells that forbid it, the cell nearest to `from` is named.
inline Answer answer(const Layer& layer, const Polygon& corners, Point from) {
    const touching::Touched found = touching::touched(layer.grid, corners);
    const auto nearest = [&](Verdict wanted) -> std::optional<Blocker> {
        // To a micrometre, so that equal distances are equal in every client. The cells are ascending.
        double least_um = HUGE_VAL;
        std::optional<std::size_t> first;
        for (const std::size_t cell : found.cells) {
            if (verdict_of(layer.class_of(cell)) != wanted) continue;
            const Point centre = layer.grid.centre_of(cell);
            const double away_um = std::round(std::hypot(centre.x_m - from.x_m, centre.y_m - from.y_m) * 1e6);
            if (!first || away_um < least_um) first = cell, least_um = away_um;
        }
        if (!first) return std::nullopt;
        const Class* named = layer.class_of(*first);
        return Blocker{layer.grid.centre_of(*first), named ? named->name : "unknown", why_of(layer, *first)};
    };
    if (auto blocker = nearest(Verdict::BLOCKED)) return {Verdict::BLOCKED, std::move(blocker)};
    if (found.outside) return {Verdict::BLOCKED, Blocker{*found.outside, "unknown", "outside of the map"}};
    if (auto blocker = nearest(Verdict::LOW)) return {Verdict::LOW, std::move(blocker)};
    return {Verdict::FREE, std::nullopt};
}

// The place in a cell that is nearest to a point.
inline Point nearest_in(const Grid& grid, std::size_t cell, Point to) {
    if (grid.cell_at(to) == cell) return to;
    const std::size_t row = cell / grid.columns();
    const double column = static_cast<double>(cell % grid.columns());
    const auto limited = [](double value, double low, double high) { return std::fmin(std::fmax(value, low), high); };
    if (const CartesianGrid* squares = grid.cartesian()) {
        const double edge = squares->edge_m(), line = static_cast<double>(row);
        const Point along = squares->to_axes(to);
        const auto near = [&](double value, double origin, double number) {
            return limited(value, origin + number * edge, origin + (number + 1.0) * edge);
        };
        return squares->from_axes(
            {near(along.x_m, squares->origin_x_m, column), near(along.y_m, squares->origin_y_m, line)});
    }
    const RadialGrid& rings = *grid.radial();
    const Point own = rings.from_centre(to);
    const double inner = rings.inner_m(row), outer = rings.outer_m(row), position = rings.position_of(own);
    if (column <= position && position <= column + 1.0) {
        const double range_m = limited(std::hypot(own.x_m, own.y_m), inner, outer);
        const double azimuth_rad = std::atan2(own.y_m, own.x_m);
        return rings.from_ego({range_m * std::cos(azimuth_rad), range_m * std::sin(azimuth_rad)});
    }
    // Beside the column, one of its two sides is nearest: an arc comes nearer towards its ends.
    const auto side = [&](double at) {
        const double azimuth_rad = at / static_cast<double>(rings.columns) * TAU;
        const double sin = std::sin(azimuth_rad), cos = std::cos(azimuth_rad);
        return touching::nearest_on({{inner * cos, inner * sin}, {outer * cos, outer * sin}}, own);
    };
    const auto away = [&](Point p) { return std::hypot(p.x_m - own.x_m, p.y_m - own.y_m); };
    const Point first = side(column), last = side(column + 1.0);
    return rings.from_ego(away(first) <= away(last) ? first : last);
}

inline std::optional<Obstacle> nearest(const Layer& layer, Meaning wanted, Point to, const Outline* own) {
    shapes::check_finite("x_m", to.x_m);
    shapes::check_finite("y_m", to.y_m);
    if (own) own->check();
    std::optional<Obstacle> found;
    for (std::size_t cell = 0; cell < layer.grid.cell_count(); ++cell) {
        const Class* here = layer.class_of(cell);
        if (!here) break;
        if (here->meaning != wanted) continue;
        const Point centre = layer.grid.centre_of(cell);
        const bool is_own = own && centre.x_m >= -own->rear_m && centre.x_m <= own->front_m &&
                            std::abs(centre.y_m) <= own->width_m / 2.0;
        if (is_own) continue;
        const Point near = nearest_in(layer.grid, cell, to);
        const double distance_m = std::hypot(near.x_m - to.x_m, near.y_m - to.y_m);
        if (!found || distance_m < found->distance_m) found = Obstacle{near, distance_m, here->name};
    }
    return found;
}

}  // namespace asking

// Whether a vehicle may drive on a polygon, and the cell that forbids it. Throws `Error` if a corner is not finite,
// corners are missing, or edges cross.
inline Answer answer(const Layer& layer, const Polygon& polygon) {
    return asking::answer(layer, shapes::corners_of(polygon), {});
}

// True if every cell that a polygon touches has a class that means free. Throws as `answer`.
inline bool is_free(const Layer& layer, const Polygon& polygon) {
    return answer(layer, polygon).verdict == Verdict::FREE;
}

// What a vehicle of this outline meets on a path, judged at poses at most 0.1 m apart. Throws `Error` if a value is not
// allowed.
inline Along along(const Layer& layer, const Path& path, const Outline& outline) {
    outline.check();
    const auto poses = std::visit([&](const auto& kind) { return shapes::poses_of(kind, outline.reach_m()); }, path);
    Along met{poses.back().along_m, std::nullopt, std::nullopt};
    for (const shapes::PathPose& pose : poses) {
        const Answer found = asking::answer(layer, outline.at(pose.place, pose.heading_rad), pose.place);
        if (found.verdict == Verdict::LOW && !met.low) met.low = Met{pose.along_m, *found.blocker};
        if (found.verdict == Verdict::BLOCKED) {
            met.blocked = Met{pose.along_m, *found.blocker};
            break;
        }
    }
    return met;
}

// The obstacle that is nearest to a point; none if the layer has none. Cells whose centre lies within `own`, the
// outline of the vehicle itself, do not count, nor do low things.
inline std::optional<Obstacle> nearest_obstacle(const Layer& layer, Point to, const Outline* own = nullptr) {
    return asking::nearest(layer, Meaning::OCCUPIED, to, own);
}

// The low thing that is nearest to a point, as `nearest_obstacle`.
inline std::optional<Obstacle> nearest_low(const Layer& layer, Point to, const Outline* own = nullptr) {
    return asking::nearest(layer, Meaning::LOW, to, own);
}

// For each cell the distance in metres from its centre to the nearest point of a cell that is not free, at most
// `most_m`; 0 in such a cell. Ground outside the grid is not free, nor are low things, unless `passes_low` is true.
// Throws `Error` "no_squares" if the grid is radial, "length" or "not_finite" if `most_m` is not allowed.
inline std::vector<double> clearance(const Layer& layer, double most_m = 10.0, bool passes_low = false) {
    shapes::check_length("most_m", most_m);
    const CartesianGrid* grid = layer.grid.cartesian();
    require(grid, "no_squares", "layer '", layer.name, "' has a radial grid; squares are needed");
    const std::size_t width = grid->width, height = grid->height;
    const std::size_t reach = touching::limited(std::ceil(most_m / grid->edge_m() + 0.5), width + height);
    // Cells up or down the column to the nearest cell that is not free, at most `reach`.
    std::vector<std::size_t> steps(layer.grid.cell_count());
    for (std::size_t cell = 0; cell < steps.size(); ++cell) {
        const Verdict verdict = asking::verdict_of(layer.class_of(cell));
        steps[cell] = verdict == Verdict::FREE || (verdict == Verdict::LOW && passes_low) ? reach : 0;
    }
    for (std::size_t column = 0; column < width; ++column) {
        std::size_t before = 0;
        const auto pass = [&](std::size_t row) {
            std::size_t& here = steps[row * width + column];
            before = here = std::min(here, before + 1);
        };
        for (std::size_t row = 0; row < height; ++row) pass(row);
        before = 0;
        for (std::size_t row = height; row-- > 0;) pass(row);
    }
    // Squares of half cells are integers, so that all clients get the same bits.
    const auto halves = [](std::size_t cells) {
        const std::uint64_t half = cells == 0 ? 0 : 2 * std::uint64_t{cells} - 1;
        return half * half;
    };
    std::vector<double> cells_m(steps.size());
    for (std::size_t cell = 0; cell < steps.size(); ++cell) {
        const std::size_t column = cell % width;
        std::uint64_t squared = std::numeric_limits<std::uint64_t>::max();
        for (std::size_t by = 0; by <= std::min(reach, width); ++by) {
            const std::size_t left = by > column ? 0 : steps[cell - by];
            const std::size_t right = by >= width - column ? 0 : steps[cell + by];
            squared = std::min(squared, halves(by) + halves(std::min(left, right)));
        }
        cells_m[cell] = std::fmin(std::sqrt(static_cast<double>(squared)) * (grid->edge_m() / 2.0), most_m);
    }
    return cells_m;
}

}  // namespace clearway
