// The text of a server's address -> host and port. Every client reads the same texts (`client/golden/addresses.json`).
#pragma once

#include <string_view>

#include "error.hpp"

namespace clearway {

// What is wrong with an address; empty if it is `HOST:PORT`, also written `http://HOST:PORT`, or with certificates
// `https://HOST:PORT`. `target` is its `HOST:PORT`.
inline std::string wrong_address(std::string_view address, bool has_certificates, std::string& target) {
    const std::string_view scheme = has_certificates ? "https://" : "http://";
    if (address.substr(0, scheme.size()) == scheme) address.remove_prefix(scheme.size());
    while (!address.empty() && address.back() == '/') address.remove_suffix(1);
    const std::size_t colon = address.rfind(':');
    if (address.substr(0, 8) == "https://") return "https needs certificates";
    if (address.find("://") != address.npos) return "another scheme than " + std::string(scheme);
    if (address.find('/') != address.npos) return "a path, or an endpoint of zenoh";
    if (colon == address.npos) return "no port";
    if (colon == 0) return "no host";
    unsigned port = address.size() == colon + 1 ? 65'536 : 0;
    for (const char digit : address.substr(colon + 1)) {
        port = digit < '0' || digit > '9' || port > 65'535 ? 65'536 : 10 * port + static_cast<unsigned>(digit - '0');
    }
    target = address;
    return port > 65'535 ? "the port is no number up to 65535" : "";
}

// `HOST:PORT` of an address. Throws an `Error` of reason "address" for another text.
inline std::string target_of(std::string_view address, bool has_certificates) {
    std::string target;
    const std::string wrong = wrong_address(address, has_certificates, target);
    require(wrong.empty(), "address", "server address \"", address, "\": ", wrong, "; HOST:PORT or http://HOST:PORT ",
            "is allowed, such as localhost:50051, and https://HOST:PORT with certificates");
    return target;
}

}  // namespace clearway
