#!/bin/sh
# Makes a Debian package of a command that is built already.
#
#   deploy/debian/make-deb.sh BINARY FOLDER
#
# Gives FOLDER/clearway_VERSION_ARCHITECTURE.deb with /usr/bin/clearway, its systemd units, the user `clearway`, the
# configuration /etc/clearway/clearway.toml, and completions. The service is not started at the first installation,
# because the mounts of the sensors are not known yet. Needs dpkg-deb, strings and strip. The same binary and commit
# give the same file.
set -eu

binary=$(realpath "${1:?usage: make-deb.sh BINARY FOLDER}")
mkdir -p "${2:?usage: make-deb.sh BINARY FOLDER}"
folder=$(realpath "$2")
cd "$(dirname "$0")/../.."
SOURCE_DATE_EPOCH=${SOURCE_DATE_EPOCH:-$(git log -1 --format=%ct)}
export SOURCE_DATE_EPOCH
umask 022

version=$("$binary" --version | cut -d ' ' -f 2)
architecture=$(dpkg --print-architecture)
# The oldest C library that has every symbol of the binary; empty if the library is inside.
glibc=$(strings -a "$binary" | grep -o '^GLIBC_2\.[0-9]*' | sort -u -t . -k 2 -n | tail -1 | cut -d _ -f 2)
depends=${glibc:+"Depends: libc6 (>= $glibc), libgcc-s1
"}
root=$(mktemp -d)
trap 'rm -rf "$root"' EXIT
package=$root/clearway

install -D "$binary" "$package/usr/bin/clearway"
strip --strip-unneeded "$package/usr/bin/clearway"
"$binary" check --default | install -D -m 644 /dev/stdin "$package/etc/clearway/clearway.toml"
for unit in clearway.service clearway.socket; do
    install -D -m 644 "deploy/systemd/$unit" "$package/lib/systemd/system/$unit"
done
install -D -m 644 deploy/systemd/clearway.sysusers "$package/usr/lib/sysusers.d/clearway.conf"
install -D -m 644 deploy/systemd/clearway.sysctl "$package/usr/lib/sysctl.d/60-clearway.conf"
"$binary" completions bash | install -D -m 644 /dev/stdin "$package/usr/share/bash-completion/completions/clearway"
"$binary" completions zsh | install -D -m 644 /dev/stdin "$package/usr/share/zsh/vendor-completions/_clearway"
doc=$package/usr/share/doc/clearway
# The pages and what they name, beside each other as in the sources.
for file in README.md ./*/README.md ./*/guide/*.md client/ros2/README.md deploy/zenoh/*.json5; do
    install -D -m 644 "$file" "$doc/$file"
done
install -D -m 644 deploy/debian/copyright "$doc/copyright"
install -D -m 755 deploy/make-test-ca.sh "$doc/deploy/make-test-ca.sh"
{
    printf 'clearway (%s) stable; urgency=medium\n\n  * See CHANGELOG.md of the sources.\n\n' "$version"
    printf ' -- The Clearway developers <clearway@localhost>  %s\n' "$(date -u -R -d "@$SOURCE_DATE_EPOCH")"
} | gzip -9n >"$root/changelog.gz"
install -D -m 644 "$root/changelog.gz" "$doc/changelog.gz"

mkdir "$package/DEBIAN"
cat >"$package/DEBIAN/control" <<CONTROL
Package: clearway
Version: $version
Architecture: $architecture
Maintainer: The Clearway developers <clearway@localhost>
Section: science
Priority: optional
${depends}Recommends: ca-certificates, openssl, procps, systemd
Installed-Size: $(du -sk --apparent-size "$package" | cut -f 1)
Description: LIDAR packets to maps of where a vehicle may drive
 Clearway reads the datagrams of Velodyne sensors, makes one map for each
 revolution, and streams the maps to path planners, dashboards and recordings.
CONTROL
echo /etc/clearway/clearway.toml >"$package/DEBIAN/conffiles"
for script in postinst prerm postrm; do
    install -m 755 "deploy/debian/$script" "$package/DEBIAN/$script"
done
dpkg-deb --root-owner-group -Zxz --build "$package" "$folder/clearway_${version}_$architecture.deb"
