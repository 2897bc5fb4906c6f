// Protobuf fields of hostile bytes, and the limits of the map format (`proto/src/limits.rs`).
//
// In: bytes from any source. Out: fields in their order, or an `Error` with the value that was refused.
#pragma once

#include <cstddef>
#include <cstdint>
#include <cstring>
#include <limits>
#include <stdexcept>
#include <string>
#include <string_view>
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

[[noreturn]] inline void refuse(const std::string& what) {
    throw Error("protobuf", "not an encoded clearway.v1.Map: " + what);
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
        if (key > UINT32_MAX || tag_ == 0) refuse("a field with the key " + std::to_string(key));
        if (type_ == VARINT) {
            number_ = read_varint();
        } else if (type_ == FIXED64) {
            number_ = read_fixed(8);
        } else if (type_ == FIXED32) {
            number_ = read_fixed(4);
        } else if (type_ == LENGTH) {
            content_ = take(read_varint());
        } else {
            refuse("field " + std::to_string(tag_) + " has the wire type " + std::to_string(type_) +
                   "; 0, 1, 2 and 5 are read");
        }
        return true;
    }

    std::uint32_t tag() const { return tag_; }
    bool has_content() const { return type_ == LENGTH; }

    Bytes content() const { return expect(LENGTH), content_; }
    std::string text() const {
        if (!is_utf8(content())) refuse("field " + std::to_string(tag_) + " is no UTF-8 text");
        return std::string(content_);
    }
    std::uint64_t varint() const { return expect(VARINT), number_; }
    std::uint32_t u32() const { return static_cast<std::uint32_t>(varint()); }
    std::int32_t i32() const { return signed_of(u32()); }
    std::int32_t s32() const { return zigzag(u32()); }
    std::int64_t s64() const { return from_bits<std::int64_t>((varint() >> 1) ^ (0 - (varint() & 1))); }
    std::uint64_t fixed64() const { return expect(FIXED64), number_; }
    std::int64_t sfixed64() const { return from_bits<std::int64_t>(fixed64()); }
    std::uint32_t fixed32() const { return expect(FIXED32), static_cast<std::uint32_t>(number_); }
    double f64() const { return from_bits<double>(fixed64()); }
    float f32() const { return from_bits<float>(fixed32()); }

    // The numbers of a repeated field, packed or not, appended to a list. `read` is the method for one of them.
    template <class Number, class Read>
    void append(std::vector<Number>& list, Type type, Read read) const {
        if (!has_content()) return list.push_back((this->*read)());
        for (Fields packed(content_); packed.at_ < packed.bytes_.size();) {
            packed.tag_ = tag_;
            packed.type_ = type;
            packed.number_ = type == VARINT ? packed.read_varint() : packed.read_fixed(type == FIXED32 ? 4 : 8);
            list.push_back((packed.*read)());
        }
    }

private:
    static std::int32_t signed_of(std::uint32_t bits) { return from_bits<std::int32_t>(bits); }
    static std::int32_t zigzag(std::uint32_t bits) { return signed_of((bits >> 1) ^ (0 - (bits & 1))); }

    template <class To, class From>
    static To from_bits(From bits) {
        static_assert(sizeof(To) == sizeof(From));
        To value;
        std::memcpy(&value, &bits, sizeof value);
        return value;
    }

    void expect(Type type) const {
        if (type_ == type) return;
        refuse("field " + std::to_string(tag_) + " has the wire type " + std::to_string(type_) + "; " +
               std::to_string(type) + " is needed");
    }

    Bytes take(std::uint64_t length) {
        const std::size_t left = bytes_.size() - at_;
        if (length > left) refuse(std::to_string(length) + " bytes claimed, " + std::to_string(left) + " left");
        const Bytes taken = bytes_.substr(at_, static_cast<std::size_t>(length));
        at_ += taken.size();
        return taken;
    }

    std::uint64_t read_fixed(unsigned bytes) {
        const Bytes taken = take(bytes);
        std::uint64_t number = 0;
        for (unsigned index = bytes; index-- > 0;) number = number << 8 | static_cast<unsigned char>(taken[index]);
        return number;
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

}  // namespace wire
}  // namespace clearway
