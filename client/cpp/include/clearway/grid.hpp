// The two grids of a layer: points of the ego frame (x forward, y left, metres) and the cells in which they lie.
#pragma once

#include <algorithm>
#include <cmath>
#include <optional>
#include <variant>

#include "wire.hpp"

namespace clearway {

inline constexpr double TAU = 6.283185307179586476925286766559;

// A point of the ego frame, in metres.
struct Point {
    double x_m = 0, y_m = 0;
    bool operator==(const Point& other) const { return x_m == other.x_m && y_m == other.y_m; }
    bool operator!=(const Point& other) const { return !(*this == other); }
};

// Rings and sectors about a centre. Cell index = row * columns + column.
struct RadialGrid {
    // Outer radius of each row in metres, ascending.
    std::vector<float> row_radius_m;
    std::uint32_t columns = 0;
    float centre_x_m = 0, centre_y_m = 0;

    bool operator==(const RadialGrid& other) const {
        return row_radius_m == other.row_radius_m && columns == other.columns && centre_x_m == other.centre_x_m &&
               centre_y_m == other.centre_y_m;
    }
    double inner_m(std::size_t row) const { return row == 0 ? 0.0 : static_cast<double>(row_radius_m[row - 1]); }
    double outer_m(std::size_t row) const { return static_cast<double>(row_radius_m[row]); }
    // The row at a distance from the centre; the number of rows beyond the last.
    std::size_t row_at(double range_m) const {
        const auto is_inside = [](float outer, double range) { return static_cast<double>(outer) < range; };
        const auto row = std::lower_bound(row_radius_m.begin(), row_radius_m.end(), range_m, is_inside);
        return static_cast<std::size_t>(row - row_radius_m.begin());
    }
    // Azimuth of a point about the centre in columns, 0 to `columns`.
    double position_of(Point from_centre) const {
        const double share = std::fmod(std::atan2(from_centre.y_m, from_centre.x_m) / TAU, 1.0);
        return (share < 0.0 ? share + 1.0 : share) * static_cast<double>(columns);
    }
    Point from_centre(Point point) const {
        return {point.x_m - static_cast<double>(centre_x_m), point.y_m - static_cast<double>(centre_y_m)};
    }
    Point from_ego(Point point) const {
        return {point.x_m + static_cast<double>(centre_x_m), point.y_m + static_cast<double>(centre_y_m)};
    }
};

// Squares along axes; seen from them, the ego frame has the heading `yaw_rad`. Cell index = iy * width + ix.
struct CartesianGrid {
    double origin_x_m = 0, origin_y_m = 0;
    std::uint32_t width = 0, height = 0;
    float cell_m = 0;
    double yaw_rad = 0;
    // Number of cell (0, 0) in the endless grid that map.proto defines.
    std::int64_t first_ix = 0, first_iy = 0;

    double edge_m() const { return static_cast<double>(cell_m); }
    Point to_axes(Point point) const { return rotated(point, yaw_rad); }
    Point from_axes(Point point) const { return rotated(point, -yaw_rad); }

    static Point rotated(Point point, double by_rad) {
        const double sin = std::sin(by_rad), cos = std::cos(by_rad);
        return {point.x_m * cos - point.y_m * sin, point.x_m * sin + point.y_m * cos};
    }
};

// Where the cells of a layer lie.
struct Grid : std::variant<RadialGrid, CartesianGrid> {
    using std::variant<RadialGrid, CartesianGrid>::variant;

    const RadialGrid* radial() const { return std::get_if<RadialGrid>(base()); }
    const CartesianGrid* cartesian() const { return std::get_if<CartesianGrid>(base()); }

    std::size_t rows() const { return radial() ? radial()->row_radius_m.size() : cartesian()->height; }
    std::size_t columns() const { return radial() ? radial()->columns : cartesian()->width; }
    std::uint64_t cell_count() const { return std::uint64_t{rows()} * columns(); }

    // The cell that contains a point; none outside the grid and if a coordinate is not finite.
    std::optional<std::size_t> cell_at(Point point) const {
        if (!std::isfinite(point.x_m) || !std::isfinite(point.y_m)) return std::nullopt;
        if (const RadialGrid* grid = radial()) {
            const Point from_centre = grid->from_centre(point);
            const std::size_t row = grid->row_at(std::hypot(from_centre.x_m, from_centre.y_m));
            if (row == rows()) return std::nullopt;
            // A share of the circle just below 1 can round up to the number of columns.
            const auto column = static_cast<std::size_t>(grid->position_of(from_centre));
            return row * columns() + std::min(column, columns() - 1);
        }
        const CartesianGrid& grid = *cartesian();
        const Point along = grid.to_axes(point);
        const double ix = std::floor((along.x_m - grid.origin_x_m) / grid.edge_m());
        const double iy = std::floor((along.y_m - grid.origin_y_m) / grid.edge_m());
        const bool is_inside = ix >= 0 && ix < grid.width && iy >= 0 && iy < grid.height;
        if (!is_inside) return std::nullopt;
        return static_cast<std::size_t>(iy) * columns() + static_cast<std::size_t>(ix);
    }

    // Centre of a cell of the grid.
    Point centre_of(std::size_t cell) const {
        const std::size_t row = cell / columns(), column = cell % columns();
        const double across = static_cast<double>(column) + 0.5;
        if (const RadialGrid* grid = radial()) {
            const double range_m = 0.5 * (grid->inner_m(row) + grid->outer_m(row));
            const double azimuth_rad = across / static_cast<double>(grid->columns) * TAU;
            return grid->from_ego({range_m * std::cos(azimuth_rad), range_m * std::sin(azimuth_rad)});
        }
        const CartesianGrid& grid = *cartesian();
        return grid.from_axes({grid.origin_x_m + across * grid.edge_m(),
                               grid.origin_y_m + (static_cast<double>(row) + 0.5) * grid.edge_m()});
    }

private:
    const std::variant<RadialGrid, CartesianGrid>* base() const { return this; }
};

}  // namespace clearway
