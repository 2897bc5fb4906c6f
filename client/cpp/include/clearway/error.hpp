// What is wrong with a map, a stream, a shape or a question.
#pragma once

#include <sstream>
#include <stdexcept>
#include <string>
#include <utility>

namespace clearway {

// A fault, in words that name the value and what is allowed. `reason` is its short name, one for all client languages.
class Error : public std::runtime_error {
public:
    Error(std::string reason, const std::string& message) : std::runtime_error(message), reason_(std::move(reason)) {}
    const std::string& reason() const { return reason_; }

private:
    std::string reason_;
};

// Throws an `Error` whose message is these parts, one after another.
template <class... Parts>
[[noreturn]] void fail(const std::string& reason, const Parts&... parts) {
    std::ostringstream message;
    (message << ... << parts);
    throw Error(reason, message.str());
}

template <class... Parts>
void require(bool is_met, const char* reason, const Parts&... parts) {
    if (!is_met) fail(reason, parts...);
}

}  // namespace clearway
