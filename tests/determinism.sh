#!/bin/bash
# Whether every build of clearway makes the same maps of the same events, byte for byte, on one processor and on two.
#
# usage: tests/determinism.sh [FILE ...]    recordings and captures; the golden recordings are always among them
#
# Builds clearway without optimization, as release, and as release for x86-64-v3, one after the other in a temporary
# folder of about 2 GB. Each build records every file; the recordings must be the same bytes, and each build verifies
# them.
set -euo pipefail
cd "$(dirname "$0")/.."
folder=$(mktemp -d "${TMPDIR:-/tmp}/determinism.XXXXXX")
trap 'rm -rf "$folder"' EXIT
mkdir "$folder/maps"

# build NAME FLAGS [OPTION ...]
build() {
    name=$1 flags=$2
    shift 2
    RUSTFLAGS="$flags" cargo build --quiet -p clearway --no-default-features --features sqlite --bin clearway \
        --target-dir "$folder/target" "$@"
    find "$folder/target" -maxdepth 2 -name clearway -type f -exec mv {} "$folder/$name" ';'
    rm -rf "$folder/target"
    echo "built $name"
}
core=profile.dev.package.clearway
build debug "" --config "$core-lidar.opt-level=0" --config "$core-mapping.opt-level=0" \
    --config "$core-proto.opt-level=0"
build release "" --release
build v3 "-C target-cpu=x86-64-v3" --release

for name in debug release v3; do
    for file in client/golden/town.mcap tests/golden/drive.mcap "$@"; do
        "$folder/$name" replay "$file" --record "$folder/maps/$(basename "$file").$name.mcap" >"$folder/log" 2>&1 ||
            { cat "$folder/log"; echo "$name: $file is not whole, or cannot be replayed"; }
    done
done
for file in "$folder"/maps/*.release.mcap; do
    cmp "$file" "${file%.release.mcap}.debug.mcap"
    cmp "$file" "${file%.release.mcap}.v3.mcap"
done
echo "$(find "$folder/maps" -name "*.release.mcap" | wc -l) recordings, the same bytes by every build"
for processors in 0 0,1; do
    for name in debug release v3; do
        echo "verified by $name on the processors $processors:"
        taskset -c "$processors" "$folder/$name" verify client/golden/town.mcap tests/golden/drive.mcap "$folder/maps" |
            tail -n 1
    done
done
for _ in 1 2 3 4 5 6 7 8 9 10; do
    "$folder/release" verify "$folder/maps" >"$folder/log" || { cat "$folder/log"; exit 1; }
done
echo "verified ten times"
