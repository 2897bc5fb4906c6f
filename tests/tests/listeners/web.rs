//! What browsers are answered: methods, hosts, origins, headers.

use super::{ask, everything, get};
use crate::fixture::{start, within};

#[tokio::test(flavor = "multi_thread")]
async fn only_get_and_head_from_the_page_itself_are_answered() {
    let mut config = everything();
    config.connections.hosts = vec!["car.example".into()];
    config.connections.origins = vec!["https://Fleet.example".into(), "file://".into()];
    let running = start(config).await;
    for address in [running.page, running.metrics, running.foxglove].map(Option::unwrap) {
        for method in ["DELETE", "POST", "PUT", "OPTIONS", "PATCH"] {
            let answer = ask(address, &get("/healthz").replace("GET", method)).await;
            assert!(answer.starts_with("HTTP/1.1 405") && answer.contains("allow: GET, HEAD"), "{method}: {answer}");
        }
        for (host, status) in [
            ("evil.example", 421),
            ("evil.example:8080", 421),
            ("car.example.evil.example", 421),
            ("", 421),
            ("[::1].evil.example", 421),
            ("127.0.0.1:8080", 200),
            ("192.168.1.7", 200),
            ("[::1]:8080", 200),
            ("[fe80::1%25eth0]:8080", 200),
            ("localhost", 200),
            ("car.example:8080", 200),
            ("Car.Example:8080", 200),
            ("LOCALHOST:8080", 200),
        ] {
            let answer = ask(address, &get("/healthz").replace("localhost", host)).await;
            let is_missing = Some(address) == running.foxglove && status == 200;
            let status = if is_missing { 404 } else { status };
            assert!(answer.starts_with(&format!("HTTP/1.1 {status}")), "{host:?}: {answer}");
            for header in ["content-security-policy: ", "x-content-type-options: nosniff", "frame-ancestors 'none'"] {
                assert!(answer.contains(header), "{header}: {answer}");
            }
        }
    }
    for twice in ["Host: evil.example", "Origin: http://localhost\r\nOrigin: http://evil.example", "Origin: \u{e9}"] {
        let answer = ask(running.page.unwrap(), &format!("{}{twice}\r\n", get("/healthz"))).await;
        assert!(answer.starts_with("HTTP/1.1 400") && answer.contains("one value of ASCII"), "{twice}: {answer}");
    }
    let head = ask(running.page.unwrap(), &get("/").replace("GET", "HEAD")).await;
    assert!(head.starts_with("HTTP/1.1 200") && head.ends_with("\r\n\r\n"), "{head}");

    let upgrade = |path: &str, origin: &str| {
        format!(
            "{}Origin: {origin}\r\nConnection: Upgrade\r\nUpgrade: websocket\r\nSec-WebSocket-Version: 13\r\n\
             Sec-WebSocket-Protocol: foxglove.sdk.v1\r\nSec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ==\r\n",
            get(path).replace("Connection: close\r\n", "")
        )
    };
    let refused = [("/live", running.page.unwrap()), ("/", running.foxglove.unwrap())];
    for (path, address) in refused {
        for origin in
            ["http://evil.example", "null", "http://localhost.evil.example", "http://localhost:1", "file://localhost"]
        {
            assert_eq!(begin(address, &upgrade(path, origin)).await, "HTTP/1.1 403", "{origin}");
        }
        for origin in ["http://localhost", "https://fleet.example", "file://"] {
            assert_eq!(begin(address, &upgrade(path, origin)).await, "HTTP/1.1 101", "{origin}");
        }
    }
    let own = "https://app.foxglove.dev";
    assert_eq!(begin(running.foxglove.unwrap(), &upgrade("/", own)).await, "HTTP/1.1 101");
    assert_eq!(begin(running.page.unwrap(), &upgrade("/live", own)).await, "HTTP/1.1 403");
    within("shutdown", running.shutdown()).await.unwrap();
}

/// The first bytes of an answer.
async fn begin(address: std::net::SocketAddr, head: &str) -> String {
    use tokio::io::{AsyncReadExt, AsyncWriteExt};
    let mut stream = tokio::net::TcpStream::connect(address).await.unwrap();
    stream.write_all(format!("{head}\r\n").as_bytes()).await.unwrap();
    let mut status = [0; 12];
    within("an answer", stream.read_exact(&mut status)).await.unwrap();
    String::from_utf8_lossy(&status).into_owned()
}
