// The shapes that questions are about: polygons of ground, outlines of vehicles, paths.
//
// In: values in the ego frame (x forward, y left, metres, radians). Out: checked corners and poses, or an `Error` with
// the value that is not allowed. The Rust and the Python client have the same reasons and poses.
#pragma once

#include <array>
#include <cstdio>

#include "grid.hpp"

namespace clearway {

// Corners of an area of ground, in order. Edges may touch, and must not cross.
using Polygon = std::vector<Point>;

// A path of constant curvature from the ego origin, straight ahead at its beginning.
struct Arc {
    // Curvature in 1/m, positive to the left; 0 is a straight line.
    double curvature_per_m = 0;
    // Length in metres; negative if the vehicle drives backwards.
    double length_m = 0;
};

// An arc, or places between which the vehicle drives straight, heading along each stretch.
using Path = std::variant<Arc, std::vector<Point>>;

namespace shapes {

// Most corners of a polygon and places of a path, longest path, greatest distance between two judged poses, and greatest
// way of the farthest corner by turning between them.
inline constexpr std::size_t CORNERS_MAX = 1000;
inline constexpr double PATH_M_MAX = 1000.0;
inline constexpr double STEP_M = 0.1;

inline void check_finite(const std::string& what, double value) {
    require(std::isfinite(value), "not_finite", what, " is ", value, "; a finite number is needed");
}

inline void check_length(const std::string& what, double value, double most = HUGE_VAL) {
    check_finite(what, value);
    const char* const allowed = most == HUGE_VAL ? "0 or more" : "0 to 1000";
    require(value >= 0 && value <= most, "length", what, " is ", value, " m; ", allowed, " m is allowed");
}

// One pose of a path.
struct PathPose {
    // Distance along the path from its beginning, in metres.
    double along_m = 0;
    Point place;
    double heading_rad = 0;
};

// The places without repetitions of the place before.
inline std::vector<Point> distinct(const std::vector<Point>& given, bool is_polygon) {
    const std::string one = is_polygon ? "corner " : "place ";
    std::vector<Point> places;
    for (std::size_t at = 0; at < given.size(); ++at) {
        check_finite(one + std::to_string(at) + ", x", given[at].x_m);
        check_finite(one + std::to_string(at) + ", y", given[at].y_m);
        if (places.empty() || places.back() != given[at]) places.push_back(given[at]);
    }
    if (is_polygon && places.size() > 1 && places.front() == places.back()) places.pop_back();
    const std::size_t least = is_polygon ? 3 : 2;
    require(places.size() >= least && places.size() <= CORNERS_MAX, "places", is_polygon ? "polygon" : "path", " has ",
            places.size(), " different places; ", least, " to 1000 are needed");
    return places;
}

// Corners of a polygon, checked; a last corner that repeats the first is left out.
inline Polygon corners_of(const Polygon& polygon) {
    const Polygon corners = distinct(polygon, true);
    const auto after = [&](std::size_t at) { return corners[(at + 1) % corners.size()]; };
    const auto side = [](Point a, Point b, Point p) {
        return (b.x_m - a.x_m) * (p.y_m - a.y_m) - (b.y_m - a.y_m) * (p.x_m - a.x_m);
    };
    const auto are_parted = [](double a, double b) { return (a > 0 && b < 0) || (a < 0 && b > 0); };
    for (std::size_t one = 0; one < corners.size(); ++one) {
        for (std::size_t other = one + 1; other < corners.size(); ++other) {
            const Point a = corners[one], b = after(one), c = corners[other], d = after(other);
            const double start = side(a, b, c), end = side(a, b, d);
            if (!are_parted(start, end) || !are_parted(side(c, d, a), side(c, d, b))) continue;
            const double share = start / (start - end);
            char near[80];
            std::snprintf(near, sizeof near, "(%.3f, %.3f)", c.x_m + share * (d.x_m - c.x_m),
                          c.y_m + share * (d.y_m - c.y_m));
            fail("crossing", "edges ", one, " and ", other, " of the polygon cross near ", near,
                 " m; a polygon that does not cross itself is needed");
        }
    }
    return corners;
}

// Steps of at most STEP_M on a way.
inline double steps_on(double way_m) { return std::max(1.0, std::ceil(way_m / STEP_M)); }

// The turn from one heading to another, the shorter way, to the left if both are equal.
inline double shorter_turn(double from_rad, double to_rad) {
    const double turn_rad = to_rad - from_rad;
    return turn_rad > TAU / 2 ? turn_rad - TAU : turn_rad <= -TAU / 2 ? turn_rad + TAU : turn_rad;
}

// The way of the farthest corner by a turn.
inline double turn_m(double turn_rad, double reach_m) {
    const double way_m = std::abs(turn_rad) * reach_m;
    require(way_m <= PATH_M_MAX, "length", "the turn of the farthest corner is ", way_m, " m; 0 to 1000 m is allowed");
    return way_m;
}

inline std::vector<PathPose> poses_of(const Arc& arc, double reach_m) {
    check_finite("curvature_per_m", arc.curvature_per_m);
    check_finite("length_m", arc.length_m);
    check_length("the path", std::abs(arc.length_m), PATH_M_MAX);
    const double steps = steps_on(std::max(std::abs(arc.length_m), turn_m(arc.curvature_per_m * arc.length_m, reach_m)));
    std::vector<PathPose> poses;
    for (double step = 0; step <= steps; ++step) {
        const double along_m = step / steps * arc.length_m;
        const double heading_rad = arc.curvature_per_m * along_m;
        // Both forms of the chord are exact; the second one has no division by a small curvature.
        const double half = heading_rad / 2.0;
        const double chord_m = std::abs(half) < 1e-9 ? along_m : along_m * std::sin(half) / half;
        const Point place{chord_m * std::cos(half), chord_m * std::sin(half)};
        poses.push_back({std::abs(along_m), place, std::fmod(heading_rad, TAU)});
    }
    return poses;
}

inline std::vector<PathPose> poses_of(const std::vector<Point>& given, double reach_m) {
    const std::vector<Point> places = distinct(given, false);
    std::vector<PathPose> poses;
    double before_m = 0;
    for (std::size_t at = 0; at + 1 < places.size(); ++at) {
        const Point a = places[at];
        const double dx = places[at + 1].x_m - a.x_m, dy = places[at + 1].y_m - a.y_m;
        const double stretch_m = std::hypot(dx, dy);
        check_length("the path", before_m + stretch_m, PATH_M_MAX);
        const double heading_rad = std::atan2(dy, dx);
        if (!poses.empty()) {
            const PathPose before = poses.back();
            const double turn_rad = shorter_turn(before.heading_rad, heading_rad);
            const double steps = steps_on(turn_m(turn_rad, reach_m));
            for (double step = 1; step < steps; ++step) {
                poses.push_back({before.along_m, before.place, before.heading_rad + step / steps * turn_rad});
            }
        }
        const double steps = steps_on(stretch_m);
        for (double step = 0; step <= steps; ++step) {
            const double share = step / steps;
            const Point place{a.x_m + share * dx, a.y_m + share * dy};
            poses.push_back({before_m + share * stretch_m, place, heading_rad});
        }
        before_m += stretch_m;
    }
    return poses;
}

}  // namespace shapes

// Outline of a vehicle about its reference point, in metres.
struct Outline {
    double front_m = 0, rear_m = 0, width_m = 0;

    // The corners of the vehicle with its reference point at a place, counter-clockwise from the front right.
    Polygon at(Point place, double heading_rad) const {
        const double sin = std::sin(heading_rad), cos = std::cos(heading_rad), left = width_m / 2.0;
        const auto corner = [&](double ahead, double side) {
            return Point{place.x_m + ahead * cos - side * sin, place.y_m + ahead * sin + side * cos};
        };
        return {corner(front_m, -left), corner(front_m, left), corner(-rear_m, left), corner(-rear_m, -left)};
    }

    // Distance of the farthest corner from the reference point.
    double reach_m() const { return std::hypot(std::max(front_m, rear_m), width_m / 2.0); }

    void check() const {
        shapes::check_length("front_m", front_m);
        shapes::check_length("rear_m", rear_m);
        shapes::check_length("width_m", width_m);
    }
};

}  // namespace clearway
