// Reads one encoded map from a file, as any transport delivers it, and says whether a car can drive 8 m straight ahead.
//
//   c++ -std=c++17 -I client/cpp/include client/cpp/examples/is_free.cpp -o is_free && ./is_free map.bin
#include <clearway/questions.hpp>

#include <fstream>
#include <iostream>
#include <iterator>

int main(int count, char** arguments) {
    if (count != 2) {
        std::cerr << "usage: is_free MAP_FILE\n";
        return 2;
    }
    std::ifstream file(arguments[1], std::ios::binary);
    const std::string bytes((std::istreambuf_iterator<char>(file)), std::istreambuf_iterator<char>());
    try {
        clearway::Map map = clearway::Map::decode(bytes);
        map.arrived(clearway::Clocks::now());
        if (const auto because = map.staleness(clearway::Clocks::now())) {
            std::cout << "STALE: " << *because << "\n";
            return 1;
        }
        const clearway::Layer& layer = map.layer("freespace");
        const clearway::Outline car{3.8, 1.0, 1.9};
        std::cout << "map " << map.header.sequence << " of " << map.header.vehicle << "\n"
                  << "here: " << (clearway::is_free(layer, car.at({0, 0}, 0)) ? "free" : "not free") << "\n";
        const clearway::Along met = clearway::along(layer, clearway::Arc{0.0, 8.0}, car);
        if (met.blocked) {
            const clearway::Blocker& by = met.blocked->blocker;
            std::cout << "ahead: blocked after " << met.blocked->along_m << " m by " << by.name << " at (" << by.at.x_m
                      << ", " << by.at.y_m << ") m" << (by.why ? ": " + *by.why : "") << "\n";
        } else {
            std::cout << "ahead: " << (met.low ? "low things" : "free") << " for " << met.length_m << " m\n";
        }
        if (const auto obstacle = clearway::nearest_obstacle(layer, {0, 0}, &car)) {
            std::cout << "nearest: " << obstacle->name << " at " << obstacle->distance_m << " m\n";
        }
    } catch (const clearway::Error& error) {
        std::cerr << error.reason() << ": " << error.what() << "\n";
        return 1;
    }
}
