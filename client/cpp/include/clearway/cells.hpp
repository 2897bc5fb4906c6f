// The cells of a channel from its payload, as `proto/src/channel` and `client/python/clearway/codec.py` decode them.
//
// In: a channel's claims and its payload, also hostile payloads. Out: raw cells in the order of the cell index, or an
// `Error` "cells". The caller bounds the number of cells. The CRC decides whether the cells are right; that a payload
// is canonical is not checked. Format: `proto/clearway/v1/map.proto`, `Encoding`.
#pragma once

#include <algorithm>
#include <array>

#include "map.hpp"

namespace clearway::codec {

enum Encoding : std::int32_t { RAW = 1, ROWS = 2, CHANGES = 3 };


inline std::size_t bytes_of(CellType type) { return type == CellType::U16 ? 2 : 1; }

// A number as a raw value of a type: its lowest bits.
inline std::int32_t wrapped(CellType type, std::uint32_t number) {
    if (type == CellType::U16) return static_cast<std::int32_t>(number & 0xffff);
    const auto byte = static_cast<std::int32_t>(number & 0xff);
    return type == CellType::I8 && byte > 127 ? byte - 256 : byte;
}

// Raw little-endian cells.
inline Cells raw(Bytes payload, CellType type) {
    Cells cells;
    for (const std::size_t size = bytes_of(type); payload.size() >= size; payload.remove_prefix(size)) {
        std::uint32_t number = 0;
        for (std::size_t byte = size; byte-- > 0;) number = number << 8 | static_cast<unsigned char>(payload[byte]);
        cells.push_back(wrapped(type, number));
    }
    return cells;
}

// CRC-32 (IEEE) of the raw little-endian cells.
inline std::uint32_t crc32(const Cells& cells, CellType type) {
    constexpr std::uint32_t OF_FOUR_BITS[16] = {
        0x00000000, 0x1db71064, 0x3b6e20c8, 0x26d930ac, 0x76dc4190, 0x6b6b51f4, 0x4db26158, 0x5005713c,
        0xedb88320, 0xf00f9344, 0xd6d6a3e8, 0xcb61b38c, 0x9b64c2b0, 0x86d3d2d4, 0xa00ae278, 0xbdbdf21c};
    std::uint32_t crc = ~0u;
    for (const std::int32_t cell : cells) {
        for (std::size_t shift = 0; shift < 8 * bytes_of(type); shift += 4) {
            crc = crc >> 4 ^ OF_FOUR_BITS[(crc ^ static_cast<std::uint32_t>(cell) >> shift) & 15];
        }
    }
    return ~crc;
}

// Reads numbers from the bits of a payload, most significant bit first.
class Bits {
public:
    Bits(Bytes payload, CellType type) : payload_(payload), type_(type) {}

    bool bit() {
        require(at_ / 8 < payload_.size(), "cells", "the cells end after the payload of ", payload_.size(), " bytes");
        const bool bit = static_cast<unsigned char>(payload_[at_ / 8]) >> (7 - at_ % 8) & 1;
        ++at_;
        return bit;
    }

    // A number in exp-Golomb code of an order: code `N` if that is 0.
    std::uint64_t number(unsigned order = 0) {
        unsigned bits = order;
        while (!bit()) require(++bits <= NUMBER_BITS_MAX, "cells", "a number exceeds ", NUMBER_BITS_MAX, " bits");
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
        require(number <= most, "cells", "a cell has the number ", number, "; at most ", most, " is allowed");
        const auto value = static_cast<std::int32_t>(number);
        return type_ == CellType::I8 ? (value >> 1 ^ -(value & 1)) : value;
    }

    // Checks that nothing follows but zeros that fill the last byte.
    void finish() {
        while (at_ % 8 != 0) require(!bit(), "cells", "a 1 follows the cells; zeros fill the last byte");
        require(at_ / 8 == payload_.size(), "cells", payload_.size() - at_ / 8, " bytes follow the cells; 0 may");
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
        require(length <= left, "cells", "a length of ", length, " cells; ", left, " are left");
        return static_cast<std::size_t>(length);
    };
    while (cells.size() < count) {
        for (std::size_t left = checked(bits.number()); left > 0; --left) {
            cells.push_back(cells.size() < columns ? 0 : cells[cells.size() - columns]);
        }
        if (cells.size() == count) break;
        const bool repeats = bits.bit();
        require(!repeats || !cells.empty(), "cells", "the first cell is as the cell before it; there is none");
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
        std::optional<bool> flag;
    };
    std::array<Runs, 65> contexts{};
    const auto read_flag = [&](std::size_t context) {
        Runs& runs = contexts[context];
        if (runs.left == 0) {
            runs.flag = runs.flag ? !*runs.flag : bits.bit();
            runs.left = bits.adaptive(runs.means[*runs.flag ? 1 : 0]) + 1;
        }
        --runs.left;
        return *runs.flag;
    };
    const Cells base = cells;
    const std::size_t count = cells.size();
    std::vector<bool> has_changed(count);
    std::uint64_t value_mean = 0;
    for (std::size_t at = 0; at < count; ++at) {
        // The cells to the left, above, to the right and below; `count` where there is none.
        const std::size_t near[4] = {at % columns != 0 ? at - 1 : count, at >= columns ? at - columns : count,
                                     (at + 1) % columns != 0 ? at + 1 : count,
                                     count - at > columns ? at + columns : count};
        constexpr std::size_t BITS[4] = {8, 4, 32, 16};
        std::size_t context = 0;
        for (int side = 0; side < 4; ++side) {
            if (near[side] < count && base[near[side]] != base[at]) context |= BITS[side];
        }
        if (near[1] < count && has_changed[near[1]]) context |= 1;
        if (near[0] < count && has_changed[near[0]]) context |= 2;
        if (!read_flag(context)) continue;
        has_changed[at] = true;
        const auto differs = [&](std::size_t index) { return index < count && cells[index] != cells[at]; };
        const std::size_t* const predicted = std::find_if(near, near + 4, differs);
        const bool is_predicted = predicted != near + 4 && !read_flag(64);
        cells[at] = is_predicted ? cells[*predicted] : bits.cell(bits.adaptive(value_mean));
    }
    for (const Runs& runs : contexts) require(runs.left == 0, "cells", "a run has ", runs.left, " flags too many");
    bits.finish();
    return cells;
}

}  // namespace clearway::codec
