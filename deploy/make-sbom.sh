#!/bin/sh
# Writes the SBOM of the command `clearway` (CycloneDX 1.5, JSON): every crate in it, with version, licence, checksum
# and what depends on what, for this host and the default features. Run it with each release build.
#
#   deploy/make-sbom.sh [FOLDER]
#
# Gives FOLDER/clearway.cdx.json (by default in target/sbom), and says how old Cargo.lock is. Needs cargo-cyclonedx,
# which it installs if it is absent.
set -eu

cd "$(dirname "$0")/.."
folder=${1:-target/sbom}
name=clearway-sbom.cdx
mkdir -p "$folder"
command -v cargo-cyclonedx >/dev/null || cargo install --quiet --locked cargo-cyclonedx@0.5.9

# The time of the commit, so that the same sources give the same file.
SOURCE_DATE_EPOCH=$(git log -1 --format=%ct)
export SOURCE_DATE_EPOCH
cargo cyclonedx -qq --manifest-path server/Cargo.toml --format json --spec-version 1.5 --override-filename "$name"
mv "server/$name.json" "$folder/clearway.cdx.json"
# It writes one file beside the Cargo.toml of each crate of the workspace.
find . -name "$name.json" -not -path "./target/*" -delete

changed=$(git log -1 --format=%ct -- Cargo.lock)
days=$((($(date +%s) - changed) / 86400))
crates=$(grep -c '"purl"' "$folder/clearway.cdx.json" || true)
echo "$folder/clearway.cdx.json: $crates components; Cargo.lock was changed $days days ago"
if [ "$days" -gt 90 ]; then
    echo "Cargo.lock is older than 90 days: run cargo update, and look at the advisories again" >&2
fi
