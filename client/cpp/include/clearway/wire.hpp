// Protobuf fields of hostile bytes, and the limits of the map format (`proto/src/limits.rs`).
//
// In: bytes from any source. Out: fields in their order, or an `Error` with the value that was refused.
#pragma once

#include <cstdint>
#include <cstring>
#include <optional>
#include <string_view>
#include <type_traits>
#include <vector>

#include "error.hpp"

namespace clearway {

// Bytes of a message or a payload. They are not copied.
using Bytes = std::string_view;

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
template <class Target> As<Form::ZIGZAG, Target> zigzag(Target& target) { return {target}; }
template <class Target> As<Form::FIXED, Target> fixed(Target& target) { return {target}; }

// A field that is passed over.
struct Unread {};

// The fields of one message, in their order.
class Fields {
public:
    enum Type : std::uint32_t { VARINT = 0, FIXED64 = 1, LENGTH = 2, FIXED32 = 5 };

    explicit Fields(Bytes bytes) : bytes_(bytes) {}

    // Goes to the next field; false at the end of the message.
    bool next() {
        if (is_at_end()) return false;
        const std::uint64_t key = varint();
        tag_ = static_cast<std::uint32_t>(key >> 3);
        type_ = static_cast<std::uint32_t>(key & 7);
        if (key > UINT32_MAX || tag_ == 0) refuse("a field with the key ", key);
        if (type_ == LENGTH) return content_ = take(varint()), true;
        const std::size_t start = at_;
        if (type_ == VARINT) {
            varint();
        } else if (type_ == FIXED64 || type_ == FIXED32) {
            take(type_ == FIXED64 ? 8 : 4);
        } else {
            refuse("field ", tag_, " has the wire type ", type_, "; 0, 1, 2 and 5 are read");
        }
        content_ = bytes_.substr(start, at_ - start);
        return true;
    }

    std::uint32_t tag() const { return tag_; }
    bool has_content() const { return type_ == LENGTH; }
    Bytes content() const { return expect(LENGTH), content_; }

    // Puts the field into a number, a text, bytes, a list, or a function that reads the content.
    template <Form form = Form::PLAIN, class Target>
    void into(Target&& target) const {
        if constexpr (std::is_invocable_v<Target, Bytes>) {
            target(content());
        } else {
            using Number = std::decay_t<Target>;
            expect(type_of<form, Number>());
            target = Fields(content_).number<form, Number>();
        }
    }
    void into(std::string& text) const {
        if (!is_utf8(content())) refuse("field ", tag_, " is no UTF-8 text");
        text = content_;
    }
    void into(Bytes& bytes) const { bytes = content(); }
    void into(Unread) const {}
    template <class Number> void into(std::optional<Number>& number) const { into(number.emplace()); }
    void into(std::vector<std::string>& texts) const { into(texts.emplace_back()); }
    // The numbers of a repeated field, packed or not.
    template <Form form = Form::PLAIN, class Number>
    void into(std::vector<Number>& list) const {
        if (!has_content()) expect(type_of<form, Number>());
        for (Fields numbers(content_); !numbers.is_at_end();) list.push_back(numbers.number<form, Number>());
    }
    template <Form form, class Target> void into(As<form, Target> as) const { into<form>(as.target); }

private:
    template <Form form, class Number>
    static constexpr Type type_of() {
        if (form != Form::FIXED && !std::is_floating_point_v<Number>) return VARINT;
        return sizeof(Number) == 8 ? FIXED64 : FIXED32;
    }

    bool is_at_end() const { return at_ == bytes_.size(); }

    void expect(Type type) const {
        if (type_ != type) refuse("field ", tag_, " has the wire type ", type_, "; ", type, " is needed");
    }

    Bytes take(std::uint64_t length) {
        const std::size_t left = bytes_.size() - at_;
        if (length > left) refuse(length, " bytes claimed, ", left, " left");
        return bytes_.substr(std::exchange(at_, at_ + static_cast<std::size_t>(length)), length);
    }

    std::uint64_t varint() {
        std::uint64_t number = 0;
        for (unsigned shift = 0; shift < 70; shift += 7) {
            const auto byte = static_cast<unsigned char>(take(1)[0]);
            if (shift == 63 && byte > 1) break;
            number |= static_cast<std::uint64_t>(byte & 0x7f) << shift;
            if (byte < 0x80) return number;
        }
        refuse("a number of more than 64 bits");
    }

    template <Form form, class Number>
    Number number() {
        using Bits = std::conditional_t<sizeof(Number) == 8, std::uint64_t, std::uint32_t>;
        constexpr bool is_varint = type_of<form, Number>() == VARINT;
        auto bits = is_varint ? static_cast<Bits>(varint()) : Bits{0};
        for (unsigned shift = 0; !is_varint && shift < 8 * sizeof bits; shift += 8) {
            bits |= static_cast<Bits>(static_cast<unsigned char>(take(1)[0])) << shift;
        }
        if (form == Form::ZIGZAG) bits = bits >> 1 ^ (0 - (bits & 1));
        Number value;
        static_assert(sizeof value == sizeof bits);
        std::memcpy(&value, &bits, sizeof value);
        return value;
    }

    Bytes bytes_, content_;
    std::size_t at_ = 0;
    std::uint32_t tag_ = 0, type_ = 0;
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
