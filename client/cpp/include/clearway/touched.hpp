// The cells that a polygon touches, with the arithmetic of `client/src/footprint/touched.rs`.
//
// In: a grid and the checked corners of a polygon in the ego frame (metres). Out: every cell that the polygon, its
// border included, touches. A cell is touched by an edge, or lies wholly inside; then the line through its centre
// crosses the polygon there.
#pragma once

#include "shapes.hpp"

namespace clearway {
namespace touching {

// Distance in metres below which a point touches a cell: far more than the rounding errors of a point on a map.
inline constexpr double TOUCH_M = 1e-9;

// The cells that a polygon touches, ascending, and its first corner outside the grid or on its border, if there is one.
struct Touched {
    std::vector<std::size_t> cells;
    std::optional<Point> outside;
};

struct Stretch {
    Point a, b;
};

inline Point between(Point a, Point b, double share) {
    return {a.x_m + share * (b.x_m - a.x_m), a.y_m + share * (b.y_m - a.y_m)};
}

// The part of a stretch where normal . p >= offset; none if there is none.
inline std::optional<Stretch> clip(Stretch stretch, Point normal, double offset) {
    const auto over = [&](Point p) { return normal.x_m * p.x_m + normal.y_m * p.y_m - offset; };
    const double start = over(stretch.a), end = over(stretch.b);
    const bool has_start = start >= 0, has_end = end >= 0;
    if (!has_start && !has_end) return std::nullopt;
    if (has_start && has_end) return stretch;
    const Point border = between(stretch.a, stretch.b, start / (start - end));
    return has_start ? Stretch{stretch.a, border} : Stretch{border, stretch.b};
}

inline Point nearest_on(Stretch stretch, Point to) {
    const double dx = stretch.b.x_m - stretch.a.x_m, dy = stretch.b.y_m - stretch.a.y_m;
    const double squared = dx * dx + dy * dy;
    if (!(squared > 0)) return stretch.a;
    const double share = ((to.x_m - stretch.a.x_m) * dx + (to.y_m - stretch.a.y_m) * dy) / squared;
    return between(stretch.a, stretch.b, std::fmin(std::fmax(share, 0.0), 1.0));
}

// A number of cells from a number that may be anything: 0 if it is negative or not a number, else at most `most`.
inline std::size_t limited(double cells, std::size_t most) {
    if (!(cells > 0)) return 0;
    return cells < static_cast<double>(most) ? static_cast<std::size_t>(cells) : most;
}

// Calls `visit` with each pair of the ascending places: the borders of the polygon on a line.
template <class Visit>
void visit_pairs(std::vector<double>& places, Visit visit) {
    // What is not a number is the last, so that the order is one for any corners.
    const auto is_before = [](double one, double other) {
        return std::isnan(other) ? !std::isnan(one) : one < other;
    };
    std::sort(places.begin(), places.end(), is_before);
    for (std::size_t at = 0; at + 1 < places.size(); at += 2) visit(places[at], places[at + 1]);
}

// Adds the touched squares; corners in cells. True if the polygon reaches outside.
inline bool add_squares(const CartesianGrid& grid, const Polygon& corners, std::vector<std::size_t>& cells) {
    const double slack = TOUCH_M / grid.edge_m();
    const std::size_t width = grid.width, height = grid.height;
    double low = HUGE_VAL, high = -HUGE_VAL;
    for (const Point corner : corners) low = std::fmin(low, corner.y_m), high = std::fmax(high, corner.y_m);
    const double first = std::floor(low - slack), last = std::floor(high + slack);
    bool is_outside = first < 0 || last >= static_cast<double>(height);
    for (std::size_t row = limited(first, height); row < limited(last + 1.0, height); ++row) {
        const auto add = [&](double from, double to) {
            const double start = std::floor(from), end = std::floor(to);
            is_outside = is_outside || start < 0 || end >= static_cast<double>(width);
            for (std::size_t column = limited(start, width); column < limited(end + 1.0, width); ++column) {
                cells.push_back(row * width + column);
            }
        };
        const double bottom = static_cast<double>(row), middle = bottom + 0.5;
        std::vector<double> crossings;
        for (std::size_t at = 0; at < corners.size(); ++at) {
            const Point a = corners[at], b = corners[(at + 1) % corners.size()];
            auto part = clip({a, b}, {0, 1}, bottom - slack);
            if (part) part = clip(*part, {0, -1}, -(bottom + 1.0 + slack));
            if (part) {
                add(std::fmin(part->a.x_m, part->b.x_m) - slack, std::fmax(part->a.x_m, part->b.x_m) + slack);
            }
            if ((a.y_m > middle) != (b.y_m > middle)) {
                crossings.push_back(a.x_m + (middle - a.y_m) / (b.y_m - a.y_m) * (b.x_m - a.x_m));
            }
        }
        visit_pairs(crossings, add);
    }
    return is_outside;
}

// Adds the touched cells of a radial grid; corners about its centre. True if the polygon reaches outside.
inline bool add_sectors(const RadialGrid& grid, const Polygon& corners, std::vector<std::size_t>& cells) {
    const std::size_t rows = grid.row_radius_m.size(), columns = grid.columns;
    const auto direction = [&](double column) {
        const double azimuth_rad = column / static_cast<double>(columns) * TAU;
        return Point{std::cos(azimuth_rad), std::sin(azimuth_rad)};
    };
    bool is_outside = false;
    for (std::size_t column = 0; column < columns; ++column) {
        const auto add = [&](double from_m, double to_m) {
            const std::size_t end = grid.row_at(to_m);
            is_outside = is_outside || end >= rows;
            for (std::size_t row = grid.row_at(from_m); row < std::min(end + 1, rows); ++row) {
                cells.push_back(row * columns + column);
            }
        };
        const double left = static_cast<double>(column);
        const Point start = direction(left), end = direction(left + 1.0), middle = direction(left + 0.5);
        std::vector<double> crossings;
        for (std::size_t at = 0; at < corners.size(); ++at) {
            const Point a = corners[at], b = corners[(at + 1) % corners.size()];
            // Left of the column's beginning and right of its end; a single column is all there is.
            std::optional<Stretch> part = Stretch{a, b};
            if (columns > 1) {
                part = clip(*part, {-start.y_m, start.x_m}, -TOUCH_M);
                if (part) part = clip(*part, {end.y_m, -end.x_m}, -TOUCH_M);
            }
            if (part) {
                const Point near = nearest_on(*part, {0, 0});
                const double farthest_m =
                    std::fmax(std::hypot(part->a.x_m, part->a.y_m), std::hypot(part->b.x_m, part->b.y_m));
                add(std::hypot(near.x_m, near.y_m) - TOUCH_M, farthest_m + TOUCH_M);
            }
            const auto across = [&](Point p) { return middle.x_m * p.y_m - middle.y_m * p.x_m; };
            const double from = across(a), to = across(b);
            if ((from > 0) != (to > 0)) {
                const Point border = between(a, b, from / (from - to));
                const double range_m = border.x_m * middle.x_m + border.y_m * middle.y_m;
                if (range_m > 0) crossings.push_back(range_m);
            }
        }
        // An odd number of borders lies ahead of a centre inside the polygon.
        if (crossings.size() % 2 == 1) crossings.push_back(0.0);
        visit_pairs(crossings, add);
    }
    return is_outside;
}

// True if a point lies outside the grid or on its border.
inline bool leaves(const Grid& grid, Point point) {
    constexpr double STEP = 2 * TOUCH_M;
    const Point around[] = {{0, 0}, {STEP, 0}, {-STEP, 0}, {0, STEP}, {0, -STEP}};
    return std::any_of(std::begin(around), std::end(around), [&](Point step) {
        return !grid.cell_at({point.x_m + step.x_m, point.y_m + step.y_m});
    });
}

inline Touched touched(const Grid& grid, const Polygon& corners) {
    Touched found;
    for (const Point corner : corners) {
        if (!std::isfinite(corner.x_m) || !std::isfinite(corner.y_m)) return {{}, corner};
    }
    Polygon own = corners;
    bool is_outside = false;
    if (const RadialGrid* rings = grid.radial()) {
        for (Point& corner : own) corner = rings->from_centre(corner);
        is_outside = add_sectors(*rings, own, found.cells);
    } else {
        const CartesianGrid& squares = *grid.cartesian();
        for (Point& corner : own) {
            const Point along = squares.to_axes(corner);
            corner = {(along.x_m - squares.origin_x_m) / squares.edge_m(),
                      (along.y_m - squares.origin_y_m) / squares.edge_m()};
        }
        is_outside = add_squares(squares, own, found.cells);
    }
    std::sort(found.cells.begin(), found.cells.end());
    found.cells.erase(std::unique(found.cells.begin(), found.cells.end()), found.cells.end());
    if (is_outside) {
        const auto corner = std::find_if(corners.begin(), corners.end(), [&](Point at) { return leaves(grid, at); });
        found.outside = corner == corners.end() ? corners.front() : *corner;
    }
    return found;
}

}  // namespace touching
}  // namespace clearway
