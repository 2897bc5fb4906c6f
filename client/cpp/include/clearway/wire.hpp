// Protobuf fields of hostile bytes, and the limits of the map format (`proto/src/limits.rs`).
//
// In: bytes from any source. Out: fields in their order, or an `Error` with the value that was refused.
#pragma once

#include <cstddef>
#include <cstdint>
#include <cstring>
#include <limits>
#include <optional>
#include <sstream>
#include <stdexcept>
#include <string>
#include <string_view>
#include <type_traits>
#include <utility>
#include <vector>

namespace clearway {

// Bytes of a message or a payload. They are not copied.
using Bytes = std::string_view;

// What is wrong with a map, a shape or a question. `reason` is the short name that all client languages share.
class Error : public std::runtime_error {
public:
    Error(std::string reason, const std::string& message) : std::runtime_error(message), reason_(std::move(reason)) {}
    const std::string& reason() const { return reason_; }

private:
    std::string reason_;
};

// Throws an `Error` whose message is these parts, one after another.
template <class... Parts>
[[noreturn]] void fail(const char* reason, const Parts&... parts) {
    std::ostringstream message;
    (message << ... << parts);
    throw Error(reason, message.str());
}

template <class... Parts>
void require(bool is_met, const char* reason, const Parts&... parts) {
    if (!is_met) fail(reason, parts...);
}

inline constexpr std::uint32_t CHANNEL_CELLS_MAX = 4u << 20;
inline constexpr std::uint64_t MAP_CELLS_MAX = 16u << 20;
inline constexpr std::size_t MAP_BYTES_MAX = 4u << 20;
inline constexpr std::size_t MAP_PARTS_MAX = 1u << 16;
inline constexpr unsigned NUMBER_BITS_MAX = 32;
inline constexpr std::int64_t SAFE_POINT_STEPS_MAX = 1 << 24;
inline constexpr std::uint32_t RGB_MAX = 0x00ffffff;
// Latest major version of the wire that is read; 0 and 1 are the first one.
inline constexpr std::uint32_t WIRE_VERSION = 1;

namespace wire {

template <class... Parts>
[[noreturn]] void refuse(const Parts&... parts) {
    fail("protobuf", "not an encoded clearway.v1 message: ", parts...);
}

// True if the bytes are UTF-8: no overlong form, no surrogate, nothing above U+10FFFF.
inline bool is_utf8(Bytes text) {
    for (std::size_t at = 0; at < text.size();) {
        const auto first = static_cast<unsigned char>(text[at++]);
        if (first < 0x80) continue;
        const int more = first >= 0xf0 ? 3 : first >= 0xe0 ? 2 : 1;
        if (first < 0xc2 || first > 0xf4 || text.size() - at < static_cast<std::size_t>(more)) return false;
        const auto second = static_cast<unsigned char>(text[at]);
        if ((first == 0xe0 && second < 0xa0) || (first == 0xed && second > 0x9f)) return false;
        if ((first == 0xf0 && second < 0x90) || (first == 0xf4 && second > 0x8f)) return false;
        for (int index = 0; index < more; ++index) {
            if ((static_cast<unsigned char>(text[at++]) & 0xc0) != 0x80) return false;
        }
    }
    return true;
}

// How an integer travels: as a varint, as a varint that alternates between the signs, or in 4 or 8 bytes.
enum class Form { PLAIN, ZIGZAG, FIXED };

// A target of `read` whose type does not say how its numbers travel.
template <Form form, class Target>
struct As {
    Target& target;
};
template <class Target>
As<Form::ZIGZAG, Target> zigzag(Target& target) { return {target}; }
template <class Target>
As<Form::FIXED, Target> fixed(Target& target) { return {target}; }

// A field that is passed over.
struct Unread {};

// The fields of one message, in their order.
class Fields {
public:
    enum Type : std::uint32_t { VARINT = 0, FIXED64 = 1, LENGTH = 2, FIXED32 = 5 };

    explicit Fields(Bytes bytes) : bytes_(bytes) {}

    // Goes to the next field; false at the end of the message.
    bool next() {
        if (at_ == bytes_.size()) return false;
        const std::uint64_t key = read_varint();
        tag_ = static_cast<std::uint32_t>(key >> 3);
        type_ = static_cast<std::uint32_t>(key & 7);
        if (key > UINT32_MAX || tag_ == 0) refuse("a field with the key ", key);
        if (type_ == LENGTH) {
            content_ = take(read_varint());
        } else {
            read_number();
        }
        return true;
    }

    std::uint32_t tag() const { return tag_; }
    bool has_content() const { return type_ == LENGTH; }
    Bytes content() const { return expect(LENGTH), content_; }

    template <Form form, class Number>
    Number number() const {
        constexpr bool is_varint = form != Form::FIXED && !std::is_floating_point_v<Number>;
        expect(is_varint ? VARINT : sizeof(Number) == 8 ? FIXED64 : FIXED32);
        using Bits = std::conditional_t<sizeof(Number) == 8, std::uint64_t, std::uint32_t>;
        auto bits = static_cast<Bits>(number_);
        if (form == Form::ZIGZAG) bits = bits >> 1 ^ (0 - (bits & 1));
        Number value;
        static_assert(sizeof value == sizeof bits);
        std::memcpy(&value, &bits, sizeof value);
        return value;
    }

    // Puts the field into a number, a text, bytes, a list, or a function that reads the content.
    template <Form form = Form::PLAIN, class Target>
    void into(Target&& target) const {
        if constexpr (std::is_invocable_v<Target, Bytes>) {
            target(content());
        } else {
            target = number<form, std::decay_t<Target>>();
        }
    }
    void into(std::string& text) const {
        if (!is_utf8(content())) refuse("field ", tag_, " is no UTF-8 text");
        text = content_;
    }
    void into(Bytes& bytes) const { bytes = content(); }
    void into(Unread) const {}
    template <class Number>
    void into(std::optional<Number>& number) const { into(number.emplace()); }
    void into(std::vector<std::string>& texts) const { into(texts.emplace_back()); }
    // The numbers of a repeated field, packed or not.
    template <Form form = Form::PLAIN, class Number>
    void into(std::vector<Number>& list) const {
        if (!has_content()) return list.push_back(number<form, Number>());
        constexpr bool is_varint = form != Form::FIXED && !std::is_floating_point_v<Number>;
        for (Fields packed(content_); packed.at_ < packed.bytes_.size();) {
            packed.tag_ = tag_;
            packed.type_ = is_varint ? VARINT : FIXED32;
            packed.read_number();
            list.push_back(packed.number<form, Number>());
        }
    }
    template <Form form, class Target>
    void into(As<form, Target> as) const { into<form>(as.target); }

private:
    void expect(Type type) const {
        if (type_ != type) refuse("field ", tag_, " has the wire type ", type_, "; ", type, " is needed");
    }

    Bytes take(std::uint64_t length) {
        const std::size_t left = bytes_.size() - at_;
        if (length > left) refuse(length, " bytes claimed, ", left, " left");
        const Bytes taken = bytes_.substr(at_, static_cast<std::size_t>(length));
        at_ += taken.size();
        return taken;
    }

    void read_number() {
        if (type_ == VARINT) {
            number_ = read_varint();
        } else if (type_ == FIXED64 || type_ == FIXED32) {
            number_ = 0;
            const Bytes taken = take(type_ == FIXED64 ? 8 : 4);
            for (std::size_t index = taken.size(); index-- > 0;) {
                number_ = number_ << 8 | static_cast<unsigned char>(taken[index]);
            }
        } else {
            refuse("field ", tag_, " has the wire type ", type_, "; 0, 1, 2 and 5 are read");
        }
    }

    std::uint64_t read_varint() {
        std::uint64_t number = 0;
        for (unsigned shift = 0; shift < 70; shift += 7) {
            const auto byte = static_cast<unsigned char>(take(1)[0]);
            if (shift == 63 && byte > 1) break;
            number |= static_cast<std::uint64_t>(byte & 0x7f) << shift;
            if (byte < 0x80) return number;
        }
        refuse("a number of more than 64 bits");
    }

    Bytes bytes_;
    std::size_t at_ = 0;
    std::uint32_t tag_ = 0, type_ = 0;
    std::uint64_t number_ = 0;
    Bytes content_;
};

// Reads a message: its field 1 into the first target, its field 2 into the second, and so on.
template <class... Targets>
void read(Bytes message, Targets&&... targets) {
    for (Fields fields(message); fields.next();) {
        std::uint32_t tag = 0;
        ((++tag == fields.tag() ? fields.into(targets) : void()), ...);
    }
}

}  // namespace wire
}  // namespace clearway
