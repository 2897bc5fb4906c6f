// Follows a vehicle's maps and says of each whether the next 20 m straight ahead are free, and what blocks them.
//
//   clearway demo     (in another terminal)
//   cmake -S client/cpp -B build -DCLEARWAY_EXAMPLES=ON && cmake --build build && build/follow localhost:50051
#include <clearway/grpc.hpp>
#include <clearway/questions.hpp>

#include <iostream>

int main(int count, char** arguments) {
    clearway::Subscription wanted;
    wanted.layers = {"freespace"};
    wanted.deltas = wanted.reconnects = true;
    clearway::MapStream maps(count > 1 ? arguments[1] : "localhost:50051", wanted);
    const clearway::Outline car{3.0, 2.0, 2.0};
    try {
        while (true) {
            const auto map = maps.next();
            const auto now = clearway::Clocks::now();
            std::cout << "map " << map->header.sequence << ", " << map->age_ns(now) / 1'000'000 << " ms old: ";
            if (const auto because = map->staleness(now)) {
                std::cout << "STALE: " << *because;
                for (const std::string& reason : maps.reasons()) std::cout << "; " << reason;
                std::cout << std::endl;
                continue;
            }
            const auto met = clearway::along(map->layer("freespace"), clearway::Arc{0.0, 20.0}, car);
            if (const auto& by = met.blocked) {
                std::cout << "blocked after " << by->along_m << " m by " << by->blocker.name;
                if (by->blocker.why) std::cout << " (" << *by->blocker.why << ")";
            } else {
                std::cout << (met.low ? "low things ahead" : "free") << " for " << met.length_m << " m";
            }
            std::cout << std::endl;
        }
    } catch (const clearway::Error& error) {
        std::cerr << error.reason() << ": " << error.what() << "\n";
        return error.reason() == "replay_ended" ? 0 : 1;
    }
}
