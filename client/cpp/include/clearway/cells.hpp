// The cells of a channel from its payload, as `proto/src/channel` and `client/python/clearway/codec.py` decode them.
//
// In: a channel's claims and its payload, also hostile ones. Out: raw cells in the order of the cell index, or an
// `Error` "cells". What a channel claims is checked before memory for its cells is allocated. The CRC decides whether
// the cells are right; that a payload is canonical is not checked. Format: `proto/clearway/v1/map.proto`, `Encoding`.
#pragma once

#include <algorithm>
#include <array>

#include "wire.hpp"

namespace clearway {

// Type of a raw cell, as on the wire.
enum class CellType : std::int32_t { U8 = 1, I8 = 2, U16 = 3 };

// Raw values in the order of the cell index, whatever their type.
using Cells = std::vector<std::int32_t>;

namespace codec {

enum Encoding : std::int32_t { RAW = 1, ROWS = 2, CHANGES = 3 };

template <class... Parts>
void check(bool is_met, const Parts&... parts) {
    require(is_met, "cells", parts...);
}

inline std::size_t bytes_of(CellType type) { return type == CellType::U16 ? 2 : 1; }

// A number as a raw value of a type: its lowest bits.
inline std::int32_t wrapped(CellType type, std::uint32_t number) {
    if (type == CellType::U16) return static_cast<std::int32_t>(number & 0xffff);
    const auto byte = static_cast<std::int32_t>(number & 0xff);
    return type == CellType::I8 && byte > 127 ? byte - 256 : byte;
}

// Raw little-endian cells.
inline Cells raw(Bytes payload, CellType type) {
    Cells cells(payload.size() / bytes_of(type));
    for (std::size_t at = 0; at < cells.size(); ++at) {
        const auto byte = [&](std::size_t index) {
            return static_cast<std::uint32_t>(static_cast<unsigned char>(payload[index]));
        };
        cells[at] = wrapped(type, type == CellType::U16 ? byte(2 * at) | byte(2 * at + 1) << 8 : byte(at));
    }
    return cells;
}

// CRC-32 (IEEE) of the raw little-endian cells.
inline std::uint32_t crc32(const Cells& cells, CellType type) {
    static const auto table = [] {
        std::array<std::uint32_t, 256> made{};
        for (std::uint32_t byte = 0; byte < 256; ++byte) {
            made[byte] = byte;
            for (int bit = 0; bit < 8; ++bit) made[byte] = made[byte] >> 1 ^ (made[byte] & 1 ? 0xedb88320u : 0);
        }
        return made;
    }();
    std::uint32_t crc = ~0u;
    for (const std::int32_t cell : cells) {
        const auto bits = static_cast<std::uint32_t>(cell);
        crc = crc >> 8 ^ table[(crc ^ bits) & 0xff];
        if (type == CellType::U16) crc = crc >> 8 ^ table[(crc ^ bits >> 8) & 0xff];
    }
    return ~crc;
}

// Reads numbers from the bits of a payload, most significant bit first.
class Bits {
public:
    Bits(Bytes payload, CellType type) : payload_(payload), type_(type) {}

    bool bit() {
        check(at_ / 8 < payload_.size(), "the payload ends inside the cells, after ", payload_.size(), " bytes");
        const bool bit = static_cast<unsigned char>(payload_[at_ / 8]) >> (7 - at_ % 8) & 1;
        ++at_;
        return bit;
    }

    // A number in exp-Golomb code of an order: code `N` if that is 0.
    std::uint64_t number(unsigned order = 0) {
        unsigned bits = order;
        while (!bit()) check(++bits <= NUMBER_BITS_MAX, "a number exceeds ", NUMBER_BITS_MAX, " bits");
        std::uint64_t number = 1;
        for (unsigned index = 0; index < bits; ++index) number = number << 1 | static_cast<std::uint64_t>(bit());
        return number - (std::uint64_t{1} << order);
    }

    // A number in code `A`; `mean` is the running mean of the numbers of its kind.
    std::uint64_t adaptive(std::uint64_t& mean) {
        unsigned order = 0;
        while (mean >> (order + 1)) ++order;
        const std::uint64_t read = number(order);
        mean = (mean + read + 1) / 2;
        return read;
    }

    // A cell of the payload's type from its number on the wire.
    std::int32_t cell(std::uint64_t number) const {
        const std::uint64_t most = type_ == CellType::U16 ? 0xffff : 0xff;
        check(number <= most, "a cell has the number ", number, "; at most ", most, " is allowed");
        const auto value = static_cast<std::int32_t>(number);
        return type_ == CellType::I8 ? (value >> 1 ^ -(value & 1)) : value;
    }

    // Checks that nothing follows but zeros that fill the last byte.
    void finish() {
        while (at_ % 8 != 0) check(!bit(), "a 1 follows the cells; zeros fill the last byte");
        check(at_ / 8 == payload_.size(), payload_.size() - at_ / 8, " bytes follow the cells; 0 are allowed");
    }

private:
    Bytes payload_;
    CellType type_;
    std::size_t at_ = 0;
};

// Decodes `ENCODING_ROWS`: copies of the row before and runs of one value, in turn.
inline Cells rows(Bits bits, std::size_t count, std::size_t columns) {
    Cells cells;
    const auto checked = [&](std::uint64_t length) {
        const std::size_t left = count - cells.size();
        check(length <= left, "a length of ", length, " cells; ", left, " are left");
        return static_cast<std::size_t>(length);
    };
    while (cells.size() < count) {
        for (std::size_t left = checked(bits.number()); left > 0; --left) {
            cells.push_back(cells.size() < columns ? 0 : cells[cells.size() - columns]);
        }
        if (cells.size() == count) break;
        const bool repeats = bits.bit();
        check(!repeats || !cells.empty(), "the first cell is as the cell before it; there is none");
        const std::int32_t value = repeats ? cells.back() : bits.cell(bits.number());
        cells.insert(cells.end(), checked(bits.number() + 1), value);
    }
    bits.finish();
    return cells;
}

// Decodes `ENCODING_CHANGES`: differences from a base, whose flags are runs in each of 65 contexts.
inline Cells changes(Bits bits, Cells cells, std::size_t columns) {
    struct Runs {
        std::uint64_t means[2] = {0, 0};
        std::uint64_t left = 0;
        bool has_begun = false, flag = false;
    };
    std::array<Runs, 65> contexts{};
    const auto read_flag = [&](std::size_t context) {
        Runs& runs = contexts[context];
        if (runs.left == 0) {
            runs.flag = runs.has_begun ? !runs.flag : bits.bit();
            runs.has_begun = true;
            runs.left = bits.adaptive(runs.means[runs.flag ? 1 : 0]) + 1;
        }
        --runs.left;
        return runs.flag;
    };
    const std::size_t count = cells.size();
    std::vector<std::uint8_t> context(count);
    // Cells above, to the left, below and to the right, each with its bit.
    const auto neighbours = [&](std::size_t at, auto visit) {
        if (at >= columns) visit(at - columns, 4);
        if (at % columns != 0) visit(at - 1, 8);
        if (count - at > columns) visit(at + columns, 16);
        if ((at + 1) % columns != 0 && at + 1 < count) visit(at + 1, 32);
    };
    for (std::size_t at = 0; at < count; ++at) {
        neighbours(at, [&](std::size_t near, int bit) {
            if (cells[near] != cells[at]) context[at] = static_cast<std::uint8_t>(context[at] | bit);
        });
    }
    std::uint64_t value_mean = 0;
    for (std::size_t at = 0; at < count; ++at) {
        if (!read_flag(context[at])) continue;
        if (count - at > columns) context[at + columns] |= 1;
        if ((at + 1) % columns != 0 && at + 1 < count) context[at + 1] |= 2;
        // The first of the cells left, above, right and below that differs from this one.
        std::array<const std::int32_t*, 4> near{};
        neighbours(at, [&](std::size_t index, int bit) {
            near[bit == 8 ? 0 : bit == 4 ? 1 : bit == 32 ? 2 : 3] = &cells[index];
        });
        const auto predicted =
            std::find_if(near.begin(), near.end(), [&](const auto* cell) { return cell && *cell != cells[at]; });
        const bool is_predicted = predicted != near.end() && !read_flag(64);
        cells[at] = is_predicted ? **predicted : bits.cell(bits.adaptive(value_mean));
    }
    for (const Runs& runs : contexts) check(runs.left == 0, "a run goes ", runs.left, " flags beyond the last cell");
    bits.finish();
    return cells;
}

}  // namespace codec
}  // namespace clearway
