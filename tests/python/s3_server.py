"""An S3-compatible server with the bucket `fleet`, and the faults that tests ask for.

    s3_server.py [ADDRESS:PORT]

It listens on a port of 127.0.0.1 unless an address is named. It prints its URL, then reads one fault a line from its
standard input and prints the line when it is in force: `none`; `refuse`, every request is answered with 503; `lie`,
every PUT is confirmed and changed before it is stored; `deny`, every request is answered with 403. It ends when its
input ends.
"""

import io
import sys
import threading

import boto3
from moto.server import DomainDispatcherApplication, create_backend_app
from werkzeug.serving import make_server

fault = "none"
moto = DomainDispatcherApplication(create_backend_app)


def application(environ, start_response):
    if fault in ("refuse", "deny"):
        status = "503 Slow Down" if fault == "refuse" else "403 Forbidden"
        start_response(status, [("Content-Length", "0")])
        return [b""]
    if fault == "lie" and environ["REQUEST_METHOD"] == "PUT":
        body = bytearray(environ["wsgi.input"].read(int(environ.get("CONTENT_LENGTH") or 0)))
        if body:
            body[len(body) // 2] ^= 1
        environ["wsgi.input"] = io.BytesIO(bytes(body))
        for name in [name for name in environ if name.startswith("HTTP_X_AMZ_CHECKSUM")]:
            del environ[name]
    return moto(environ, start_response)


def main():
    global fault
    address, port = (sys.argv[1:] or ["127.0.0.1:0"])[0].split(":")
    server = make_server(address, int(port), application, threaded=True)
    threading.Thread(target=server.serve_forever, daemon=True).start()
    url = f"http://{address}:{server.server_port}"
    keys = {"aws_access_key_id": "test", "aws_secret_access_key": "test", "region_name": "us-east-1"}
    boto3.client("s3", endpoint_url=url, **keys).create_bucket(Bucket="fleet")
    print(url, flush=True)
    for line in sys.stdin:
        fault = line.strip()
        print(fault, flush=True)


main()
