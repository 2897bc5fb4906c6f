#!/bin/sh
# Makes a CA for trying out TLS, and certificates of it: a server's (localhost) and one for each role. Not for
# production: the CA's key lies beside them, and nothing can be revoked.
#
#   deploy/make-test-ca.sh FOLDER [DAYS [NAMES]]
#
# NAMES are further names of the server, such as DNS:clearway-router-a,DNS:vehicle.local,IP:192.168.1.10.
# Gives FOLDER/ca.pem, and {server,reader,ingester,operator}.{pem,key}. Needs openssl.
set -eu

folder=${1:?usage: make-test-ca.sh FOLDER [DAYS [NAMES]]}
days=${2:-30}
names=DNS:localhost,IP:127.0.0.1${3:+,$3}
umask 077
mkdir -p "$folder"
cd "$folder"

new_key() {
    openssl genpkey -quiet -algorithm EC -pkeyopt ec_paramgen_curve:P-256 -out "$1.key"
}

new_key ca
openssl req -new -x509 -key ca.key -days "$days" -subj "/CN=Clearway test CA" \
    -addext "basicConstraints=critical,CA:TRUE" -addext "keyUsage=critical,keyCertSign" -out ca.pem

certificate() { # name, extended key usage, alternative names
    new_key "$1"
    printf 'basicConstraints=CA:FALSE\nextendedKeyUsage=%s\nsubjectAltName=%s\n' "$2" "$3" >"$1.ext"
    openssl req -new -key "$1.key" -subj "/CN=$1" -out "$1.csr"
    openssl x509 -req -in "$1.csr" -CA ca.pem -CAkey ca.key -CAcreateserial -days "$days" -extfile "$1.ext" \
        -out "$1.pem" 2>/dev/null
    rm "$1.csr" "$1.ext"
}

certificate server serverAuth,clientAuth "$names"
for role in reader ingester operator; do
    certificate "$role" clientAuth "DNS:$role"
done
echo "made $(pwd)/ca.pem and the certificates of server, reader, ingester and operator, valid for $days days"
