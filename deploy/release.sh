#!/bin/sh
# Makes everything that a release has, for this host's architecture.
#
#   deploy/release.sh FOLDER [BINARY]
#
# Gives in FOLDER:
#   clearway-VERSION-ARCHITECTURE.tar.gz             the production build: the command, its units and configurations
#   clearway_VERSION_ARCHITECTURE.deb                the Debian package of the first
#   clearway-VERSION.tar.gz, clearway-*.whl          the Python client, to be built and built
#   clearway-map-VERSION.tgz                         the decoder for browsers and Node
#   clearway-foxglove-VERSION.foxe                   the extension for Foxglove
#   clearway.cdx.json                                what is in it (CycloneDX)
#   SHA256SUMS                                       checksums of all these; sha256sum --check SHA256SUMS
#
# The binary needs no library. With BINARY none is built: that one is packed. Needs cargo, dpkg-deb, objdump and strip
# (binutils), python3 with venv, npm.
set -eu

mkdir -p "${1:?usage: release.sh FOLDER [BINARY]}"
folder=$(realpath "$1")
given=${2:+$(realpath "$2")}
cd "$(dirname "$0")/.."
SOURCE_DATE_EPOCH=$(git log -1 --format=%ct)
export SOURCE_DATE_EPOCH
architecture=$(uname -m)
root=$(mktemp -d)
trap 'rm -rf "$root"' EXIT

# Refuses a given binary that needs more libraries than every Linux with glibc has, and one built here that needs any.
check_libraries() {
    objdump -p "$1" | sed -n 's/^ *NEEDED *//p' | while read -r library; do
        case ${given:+$library} in
            libc.so.6 | libm.so.6 | libgcc_s.so.1 | libdl.so.2 | libpthread.so.0 | librt.so.1 | ld-linux-*) ;;
            *) echo "$1 needs $library: allowed are none, and libc, libm and libgcc_s for a given binary" >&2 && exit 1 ;;
        esac
    done
}

if [ -z "$given" ]; then
    # With the C library inside, so that it runs on every Linux, also on a Linux older than this machine's.
    target=$(rustc -vV | sed -n 's/^host: //p')
    RUSTFLAGS="-C target-feature=+crt-static" cargo build --release --locked --target "$target" \
        --package clearway --no-default-features --features sqlite,store,zenoh
fi
binary=${given:-${CARGO_TARGET_DIR:-target}/$target/release/clearway}
version=$("$binary" --version | cut -d ' ' -f 2)
name=clearway-$version-$architecture
install -D "$binary" "$root/$name/bin/clearway"
strip --strip-unneeded "$root/$name/bin/clearway"
check_libraries "$root/$name/bin/clearway"
cp -R LICENSE README.md CHANGELOG.md SECURITY.md deploy "$root/$name"
cp -R --parents server/README.md server/guide client/README.md client/guide client/ros2 "$root/$name"
tar -C "$root" --sort=name --owner=0 --group=0 --numeric-owner --mtime="@$SOURCE_DATE_EPOCH" -c "$name" |
    gzip -n >"$folder/$name.tar.gz"
deploy/debian/make-deb.sh "$binary" "$folder"
deploy/make-sbom.sh "$folder"

# The packages of the clients, from a copy: a build leaves its traces.
mkdir "$root/source"
git archive HEAD LICENSE client proto | tar -x -C "$root/source"
python3 -m venv "$root/venv"
"$root/venv/bin/pip" install --quiet build
"$root/venv/bin/python" -m build --outdir "$folder" "$root/source/client/python" >/dev/null
cp "$root/source/LICENSE" "$root/source/client/web"
npm pack --silent --pack-destination "$folder" "$root/source/client/web" >/dev/null
cd "$root/source/client/web/foxglove"
npm install --silent --no-audit --no-fund >/dev/null
npm run --silent package -- --out "$folder/clearway-foxglove-$version.foxe" >/dev/null

cd "$folder"
sha256sum -- *.tar.gz *.whl *.tgz *.foxe *.deb *.cdx.json >SHA256SUMS
cat SHA256SUMS
