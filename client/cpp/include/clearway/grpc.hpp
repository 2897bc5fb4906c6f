// Maps of one vehicle over gRPC: the address of a server -> a stream of the newest maps.
//
// A stream has one map in flight and acknowledges it when the reader asks for the next map, so the server holds the
// newest map for the reader, and skips and counts the maps between. Messages are read and written as bytes: no
// generated code. Needs gRPC's C++ library (Debian: libgrpc++-dev, protobuf-compiler-grpc), the CMake target
// `clearway::grpc`.
#pragma once

#include <algorithm>
#include <array>
#include <chrono>
#include <condition_variable>
#include <mutex>
#include <thread>

#include <grpcpp/grpcpp.h>
#include <grpcpp/support/sync_stream.h>

#include "address.hpp"
#include "map.hpp"

namespace clearway {

// Which maps a stream gives: `Selection` of service.proto. The default is every layer of the server's only vehicle.
struct Subscription {
    std::string vehicle;
    std::vector<std::string> layers;
    // Highest rate in maps per second; none: every map.
    std::optional<double> max_rate_hz;
    // Part of each layer in the ego frame, in metres: x from, x to, y from, y to; none: the whole layer.
    std::optional<std::array<double, 4>> region;
    // Layers may travel as changes of the map before: fewer bytes, the same maps.
    bool deltas = false;
    // A stream that a server or a connection has ended is opened again, after pauses of 0.1 to 5 s, unless the server
    // refuses the subscription itself, or knows no such vehicle before the first map.
    bool reconnects = false;
};

namespace grpc_stream {

using Buffer = ::grpc::ByteBuffer;
using Call = ::grpc::ClientReaderWriter<Buffer, Buffer>;

inline constexpr std::chrono::milliseconds PAUSE_MIN{100}, PAUSE_MAX{5000}, STALE_LATE_MAX{20}, LOOK{1000};
// A map that is stamped farther ahead of this machine's clock is no reason to refuse maps with earlier stamps.
inline constexpr std::int64_t AHEAD_NS_MAX = 1'000'000'000;

// A protobuf message that is written field by field.
struct Message {
    std::string bytes;

    void put(std::uint64_t number) {
        for (; number >= 0x80; number >>= 7) bytes += static_cast<char>(number | 0x80);
        bytes += static_cast<char>(number);
    }
    void number(unsigned tag, std::uint64_t value) { put(tag << 3), put(value); }
    void content(unsigned tag, const std::string& value) { put(tag << 3 | 2), put(value.size()), bytes += value; }
    void real(unsigned tag, double value) {
        std::uint64_t bits;
        std::memcpy(&bits, &value, sizeof bits);
        put(tag << 3 | 1);
        for (int byte = 0; byte < 8; ++byte) bytes += static_cast<char>(bits >> 8 * byte);
    }
    Buffer buffer() const {
        const ::grpc::Slice slice(bytes);
        return Buffer(&slice, 1);
    }
};

// The first request of a stream: one map in flight, and states while no map comes.
inline Message selection(const Subscription& wanted) {
    Message selection, request;
    selection.content(1, wanted.vehicle);
    for (const std::string& layer : wanted.layers) selection.content(2, layer);
    selection.number(3, 1);
    if (wanted.max_rate_hz) selection.real(4, *wanted.max_rate_hz);
    if (wanted.region) {
        Message region;
        for (unsigned side = 0; side < 4; ++side) region.real(side + 1, (*wanted.region)[side]);
        selection.content(5, region.bytes);
    }
    selection.number(6, wanted.deltas);
    selection.number(7, 1);
    request.content(1, selection.bytes);
    return request;
}

// A connection of its own, with a small window, as Python's client has it: a server that disappears is noticed after
// two intervals of 2 s, and no proxy of the environment is asked.
inline std::shared_ptr<::grpc::Channel> channel(const std::string& server,
                                                const std::shared_ptr<::grpc::ChannelCredentials>& credentials) {
    ::grpc::ChannelArguments arguments;
    arguments.SetInt(GRPC_ARG_KEEPALIVE_TIME_MS, 2000);
    arguments.SetInt(GRPC_ARG_KEEPALIVE_TIMEOUT_MS, 2000);
    arguments.SetInt(GRPC_ARG_MIN_RECONNECT_BACKOFF_MS, 5000);
    arguments.SetInt(GRPC_ARG_HTTP2_STREAM_LOOKAHEAD_BYTES, 65'535);
    arguments.SetInt(GRPC_ARG_HTTP2_BDP_PROBE, 0);
    arguments.SetInt(GRPC_ARG_USE_LOCAL_SUBCHANNEL_POOL, 1);
    arguments.SetInt(GRPC_ARG_ENABLE_HTTP_PROXY, 0);
    arguments.SetMaxReceiveMessageSize(static_cast<int>(MAP_BYTES_MAX) + 65'536);
    const auto used = credentials ? credentials : ::grpc::InsecureChannelCredentials();
    return ::grpc::CreateCustomChannel(target_of(server, credentials != nullptr), used, arguments);
}

// All bytes of a message.
inline std::string flat(const Buffer& buffer) {
    std::vector<::grpc::Slice> slices;
    if (!buffer.Dump(&slices).ok()) wire::refuse("a message that is not whole");
    std::string bytes;
    for (const auto& slice : slices) bytes.append(reinterpret_cast<const char*>(slice.begin()), slice.size());
    return bytes;
}

// Why a call has ended; the reason is the name of the status code.
inline Error ended(const std::string& server, const ::grpc::Status& status) {
    constexpr const char* NAMES[] = {"OK", "CANCELLED", "UNKNOWN", "INVALID_ARGUMENT", "DEADLINE_EXCEEDED", "NOT_FOUND",
                                     "ALREADY_EXISTS", "PERMISSION_DENIED", "RESOURCE_EXHAUSTED", "FAILED_PRECONDITION",
                                     "ABORTED", "OUT_OF_RANGE", "UNIMPLEMENTED", "INTERNAL", "UNAVAILABLE", "DATA_LOSS",
                                     "UNAUTHENTICATED"};
    const auto code = static_cast<std::size_t>(status.error_code());
    if (status.ok()) return Error("ended", server + ": the server has ended the stream");
    return Error(NAMES[code < std::size(NAMES) ? code : 2], server + ": " + status.error_message());
}

// True if another attempt would end in the same way: the request or the client itself is refused.
inline bool is_lasting(const Error& ended) {
    constexpr std::string_view REASONS[] = {"INVALID_ARGUMENT", "PERMISSION_DENIED", "UNAUTHENTICATED",
                                            "FAILED_PRECONDITION", "UNIMPLEMENTED"};
    return std::find(std::begin(REASONS), std::end(REASONS), ended.reason()) != std::end(REASONS);
}

// True if a map replaces the newest map: it is of another run, later in this one, or the run has begun again in it.
inline bool replaces(const Map& map, const Map& newest, Clocks now) {
    if (newest.header.boot_id != map.header.boot_id || map.header.sequence > newest.header.sequence) return true;
    const std::int64_t end_ns = newest.header.capture_end_ns;
    const bool is_ahead = end_ns > now.wall_ns && end_ns - now.wall_ns > AHEAD_NS_MAX;
    return !map.is_stale(now) && (map.header.capture_end_ns > end_ns || is_ahead || newest.is_stale(now));
}

}  // namespace grpc_stream

// Stream of a vehicle's newest maps, which a thread of its own receives. It ends when it is destroyed. `next`, `skipped`
// and `left_out` are for one thread.
class MapStream {
public:
    // Begins to connect to `HOST:PORT`, also written `http://HOST:PORT`, in plain text, or with the certificates of
    // `grpc::SslCredentials` `https://HOST:PORT`. Throws `Error` of reason "address" for another text.
    explicit MapStream(const std::string& address, Subscription wanted = {},
                       std::shared_ptr<::grpc::ChannelCredentials> credentials = nullptr)
        : server_(target_of(address, credentials != nullptr)), wanted_(std::move(wanted)),
          credentials_(std::move(credentials)),
          thread_([this] { receive_streams(); }) {}
    MapStream(const MapStream&) = delete;
    MapStream& operator=(const MapStream&) = delete;

    ~MapStream() {
        {
            const std::lock_guard<std::mutex> lock(mutex_);
            is_closed_ = true;
            if (context_) context_->TryCancel();
        }
        changed_.notify_all();
        thread_.join();
    }

    // Waits for a map newer than the last one, which counts as handled, or until that one is stale: it is then returned
    // again, once, at most 20 ms late. A wait of `timeout` returns the newest map again, stale or not, and null before
    // the first. Throws `Error` with a reason that Python's client has too: the name of a gRPC
    // status, "ended" if the server has ended the stream, "replay_ended" (call again for the maps of a replay that is
    // set back), or the fault of a map that is refused.
    std::shared_ptr<const Map> next(std::optional<std::chrono::milliseconds> timeout = std::nullopt) {
        using Steady = std::chrono::steady_clock;
        const auto start = Steady::now();
        std::unique_lock<std::mutex> lock(mutex_);
        if (given_ == newest_) acknowledge();
        while (true) {
            if (given_ != newest_) return give();
            if (std::exchange(is_replay_end_, false)) fail("replay_ended", "the replay has ended");
            if (ended_) throw *ended_;
            if (is_fresh_ && given_->is_stale(Clocks::now())) {
                is_fresh_ = false;
                return given_;
            }
            const auto waited = std::chrono::duration_cast<std::chrono::milliseconds>(Steady::now() - start);
            if (timeout && waited >= *timeout) return given_;
            const auto look = is_fresh_ ? grpc_stream::STALE_LATE_MAX : grpc_stream::LOOK;
            changed_.wait_for(lock, timeout ? std::min(look, *timeout - waited) : look);
        }
    }

    // Maps between the last two: skipped because the reader, its link or its connection was slow or away, and left out
    // by `max_rate_hz`. 0 if the server has started again between, or the run has begun again.
    std::uint64_t skipped() const { return skipped_; }
    std::uint64_t left_out() const { return left_out_; }

    // Why no map comes, worst first: the reasons of the vehicle's state, or why there is no connection.
    std::vector<std::string> reasons() const {
        const std::lock_guard<std::mutex> lock(mutex_);
        return reasons_;
    }

private:
    // Returns the newest map. The lock is held.
    std::shared_ptr<const Map> give() {
        const Header& now = newest_->header;
        const bool is_next = given_ && given_->header.boot_id == now.boot_id && given_->header.sequence < now.sequence;
        const std::uint64_t between = is_next ? now.sequence - given_->header.sequence - 1 : 0;
        left_out_ = std::exchange(left_out_since_, 0);
        skipped_ = between - std::min(between, left_out_);
        given_ = newest_;
        is_fresh_ = !given_->is_stale(Clocks::now());
        return given_;
    }

    // Acknowledges the map that was received last, so that the server sends the next. The lock is held.
    void acknowledge() {
        if (!unacknowledged_) return;
        grpc_stream::Message request;
        request.number(2, *std::exchange(unacknowledged_, std::nullopt));
        call_->Write(request.buffer());
    }

    // Takes one `MapUpdate`: a map, the end of a replay, or the state of a vehicle without a map.
    void receive(Bytes update) {
        Bytes encoded;
        std::uint64_t left_out = 0, is_end = 0;
        std::optional<std::vector<std::string>> reasons;
        const auto vehicle = [&](Bytes state) {
            reasons.emplace();
            for (wire::Fields fields(state); fields.next();) {
                if (fields.tag() == 16) fields.into(*reasons);
            }
        };
        const wire::Unread other;
        wire::read(update, encoded, other, other, left_out, is_end, other, vehicle);
        std::shared_ptr<Map> map;
        if (is_end == 0 && !reasons) {
            map = std::make_shared<Map>(Map::decode(encoded, newest_.get()));
            map->arrived(Clocks::now());
        }
        const std::lock_guard<std::mutex> lock(mutex_);
        is_replay_end_ = is_replay_end_ || is_end != 0;
        left_out_since_ += left_out;
        if (!map) {
            if (reasons) reasons_ = std::move(*reasons);
            return changed_.notify_all();
        }
        reasons_.clear();
        unacknowledged_ = map->header.sequence;
        // A stream that is opened again begins with the newest map, also if it was received before.
        if (newest_ && !grpc_stream::replaces(*map, *newest_, Clocks::now())) return acknowledge();
        newest_ = std::move(map);
        changed_.notify_all();
    }

    // Receives one stream; returns why it has ended. Throws the fault of a map that is refused.
    Error receive_stream() {
        const auto channel = grpc_stream::channel(server_, credentials_);
        {
            const std::lock_guard<std::mutex> lock(mutex_);
            unacknowledged_.reset();
            call_.reset();
            context_ = std::make_unique<::grpc::ClientContext>();
            if (is_closed_) context_->TryCancel();
        }
        // As generated code opens a call.
        using Factory = ::grpc::internal::ClientReaderWriterFactory<grpc_stream::Buffer, grpc_stream::Buffer>;
        using Method = ::grpc::internal::RpcMethod;
        const Method method("/clearway.v1.MapService/Watch", Method::BIDI_STREAMING);
        call_.reset(Factory::Create(channel.get(), method, context_.get()));
        call_->Write(grpc_stream::selection(wanted_).buffer());
        try {
            for (grpc_stream::Buffer buffer; call_->Read(&buffer);) receive(grpc_stream::flat(buffer));
        } catch (const Error&) {
            context_->TryCancel();
            call_->Finish();
            throw;
        }
        const ::grpc::Status status = call_->Finish();
        const auto& metadata = context_->GetServerTrailingMetadata();
        const auto served_at = metadata.find("clearway-served-at");
        if (served_at == metadata.end() || std::exchange(is_led_, true)) return grpc_stream::ended(server_, status);
        // The server at this address serves the vehicle.
        server_ = std::string(served_at->second.data(), served_at->second.size());
        return receive_stream();
    }

    // Receives streams until the last one has ended.
    void receive_streams() {
        auto pause = grpc_stream::PAUSE_MIN;
        while (true) {
            const auto before = newest_;
            std::optional<Error> ended;
            bool is_last = !wanted_.reconnects;
            try {
                ended = receive_stream();
                is_last = is_last || grpc_stream::is_lasting(*ended) || (ended->reason() == "NOT_FOUND" && !newest_);
            } catch (const Error& refused) {
                ended = refused;
                is_last = true;
            }
            std::unique_lock<std::mutex> lock(mutex_);
            if (is_last || is_closed_) {
                ended_ = ended;
                return changed_.notify_all();
            }
            reasons_ = {ended->what()};
            pause = newest_ == before ? std::min(2 * pause, grpc_stream::PAUSE_MAX) : grpc_stream::PAUSE_MIN;
            changed_.wait_for(lock, pause, [&] { return is_closed_; });
        }
    }

    // Used by the thread alone.
    std::string server_;
    const Subscription wanted_;
    const std::shared_ptr<::grpc::ChannelCredentials> credentials_;
    bool is_led_ = false;

    mutable std::mutex mutex_;
    std::condition_variable changed_;
    std::unique_ptr<::grpc::ClientContext> context_;
    std::unique_ptr<grpc_stream::Call> call_;
    std::shared_ptr<const Map> newest_, given_;
    std::optional<std::uint64_t> unacknowledged_;
    std::uint64_t left_out_since_ = 0, skipped_ = 0, left_out_ = 0;
    std::vector<std::string> reasons_;
    std::optional<Error> ended_;
    bool is_fresh_ = false, is_replay_end_ = false, is_closed_ = false;

    // The last member: it uses the others.
    std::thread thread_;
};

}  // namespace clearway
