//! A client that knows nothing but HTTP.

use std::io::{Read, Write};
use std::net::TcpStream;

use serde_json::{Value, json};

use super::program::Serving;
use super::wire::raw;

/// What a server answered.
pub struct Answer {
    pub code: u16,
    pub head: String,
    pub body: Vec<u8>,
}

impl Answer {
    pub fn json(&self) -> Value {
        serde_json::from_slice(&self.body)
            .unwrap_or_else(|error| panic!("{error}: {}", String::from_utf8_lossy(&self.body)))
    }

    pub fn text(&self) -> String {
        String::from_utf8(self.body.clone()).expect("text")
    }

    pub fn has(&self, header: &str) -> bool {
        self.head.to_ascii_lowercase().contains(&format!("\r\n{header}"))
    }

    pub fn header(&self, name: &str) -> String {
        let line =
            self.head.lines().filter_map(|line| line.split_once(": ")).find(|(key, _)| key.eq_ignore_ascii_case(name));
        line.unwrap_or_else(|| panic!("no {name} in {}", self.head)).1.to_owned()
    }

    /// The reason of a refusal, and the first field that it names.
    pub fn refusal(&self) -> (String, String) {
        let error = &self.json()["error"];
        assert_eq!(error["code"], self.code, "{error}");
        let details = error["details"].as_array().expect("details").clone();
        let of =
            |kind: &str| details.iter().find(|detail| detail["@type"].as_str().is_some_and(|at| at.ends_with(kind)));
        let reason = of("ErrorInfo").and_then(|info| info["reason"].as_str()).unwrap_or_default().to_owned();
        let field = of("BadRequest").and_then(|bad| bad["fieldViolations"][0]["field"].as_str()).unwrap_or_default();
        (reason, field.to_owned())
    }
}

/// A request of HTTP/1.0, whose answer ends with the connection.
pub fn request(server: &Serving, verb: &str, path: &str, headers: &[(&str, &str)], body: &[u8]) -> Answer {
    let address = server.http.strip_prefix("http://").expect("an address");
    request_for(server, address, verb, path, headers, body)
}

/// The same for a host of this name.
pub fn request_for(
    server: &Serving,
    host: &str,
    verb: &str,
    path: &str,
    headers: &[(&str, &str)],
    body: &[u8],
) -> Answer {
    let address = server.http.strip_prefix("http://").expect("an address");
    let mut connection = TcpStream::connect(address).expect("the port answers");
    let mut head = format!("{verb} {path} HTTP/1.0\r\nhost: {host}\r\ncontent-length: {}\r\n", body.len());
    for (name, value) in headers {
        head.push_str(&format!("{name}: {value}\r\n"));
    }
    connection.write_all(format!("{head}\r\n").as_bytes()).expect("sent");
    // A server that refuses a body does not read it to its end.
    let _ = connection.write_all(body);
    let mut answer = Vec::new();
    let _ = connection.read_to_end(&mut answer);
    let end = answer.windows(4).position(|four| four == b"\r\n\r\n").expect("a head");
    let head = String::from_utf8(answer[..end].to_vec()).expect("text");
    let code = head.split(' ').nth(1).and_then(|code| code.parse().ok()).expect("a code");
    Answer { code, head, body: answer[end + 4..].to_vec() }
}

pub fn get(server: &Serving, path: &str) -> Answer {
    request(server, "GET", path, &[], &[])
}

pub fn post(server: &Serving, path: &str, body: &Value) -> Answer {
    request(server, "POST", path, &[("content-type", "application/json")], body.to_string().as_bytes())
}

/// A small TrackSet.
pub fn tracks() -> Value {
    let raw = raw(3, 4);
    json!({
        "trackCount": raw.track_count,
        "views": [{"name": "a.jpg"}, {}, {"size": {"widthPx": 640, "heightPx": 480}}],
        "viewIndices": raw.view, "trackIndices": raw.track, "xs": raw.x, "ys": raw.y,
    })
}

/// The path of a job, or of an input, by its name.
pub fn path_of(resource: &Value) -> String {
    format!("/v1/{}", resource["name"].as_str().expect("a name"))
}
