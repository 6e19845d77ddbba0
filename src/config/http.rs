//! The section `[http]`.

use std::net::{IpAddr, Ipv4Addr, SocketAddr};

use axum::http::uri::Authority;
use serde::{Deserialize, Deserializer, Serialize, Serializer};

use super::Error;
use super::sections::parse_address;

/// The port for JSON over HTTP, with the keys and certificates of the gRPC port.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct Http {
    /// Address and port to listen on, port 0 takes a free one; `off`: there is none.
    #[serde(deserialize_with = "address_or_off", serialize_with = "or_off")]
    pub listen: Option<SocketAddr>,
    /// Largest body of JSON.
    pub max_body_bytes: usize,
    /// Names of hosts under which the port is reached, separated by commas; of no use with keys. Without keys only
    /// addresses and localhost are answered else: a page could have its own name point to this machine.
    pub hosts: String,
    /// Origins of pages that may call the API from a browser, separated by commas; none by default: whoever opens such
    /// a page lends it what the browser's machine may reach.
    pub allowed_origins: String,
}

impl Http {
    /// The names of hosts, one by one.
    pub fn hosts(&self) -> Vec<String> {
        words(&self.hosts)
    }

    /// The origins, one by one.
    pub fn allowed_origins(&self) -> Vec<String> {
        words(&self.allowed_origins)
    }

    /// Whether the origins are what a browser calls a page's.
    pub(super) fn validate(&self) -> Result<(), Error> {
        let is_origin = |text: &str| {
            let Some((scheme @ ("http" | "https"), authority)) = text.split_once("://") else { return false };
            // A browser leaves the port of the scheme out, so that an origin with it would never be met.
            let is_default_port = |port| matches!((scheme, port), ("http", 80) | ("https", 443));
            let parsed = authority.parse::<Authority>();
            !authority.contains(['*', '@'])
                && parsed.is_ok_and(|authority| !authority.port_u16().is_some_and(is_default_port))
        };
        match self.allowed_origins().into_iter().find(|origin| !is_origin(origin)) {
            Some(wrong) => Err(Error::Value {
                key: "http.allowed_origins",
                found: format!("`{wrong}`"),
                right: "origins of pages as browsers write them, without a path and without port 443 of https and 80 of http, such \
                        as `https://app.example`, separated by commas",
            }),
            None => Ok(()),
        }
    }
}

/// What stands between the commas of a text.
fn words(text: &str) -> Vec<String> {
    text.split(',').map(|word| word.trim().to_owned()).filter(|word| !word.is_empty()).collect()
}

impl Default for Http {
    fn default() -> Self {
        Self {
            // Loopback, as gRPC's; 8080 is the customary port for HTTP that needs no rights.
            listen: Some(SocketAddr::new(IpAddr::V4(Ipv4Addr::LOCALHOST), 8080)),
            max_body_bytes: crate::http::MAX_BODY_BYTES,
            hosts: String::new(),
            allowed_origins: String::new(),
        }
    }
}

/// What turns a port off.
const OFF: &str = "off";

fn address_or_off<'de, D: Deserializer<'de>>(deserializer: D) -> Result<Option<SocketAddr>, D::Error> {
    let text = String::deserialize(deserializer)?;
    if text == OFF { Ok(None) } else { parse_address(&text).map(Some) }
}

fn or_off<S: Serializer>(address: &Option<SocketAddr>, serializer: S) -> Result<S::Ok, S::Error> {
    match address {
        Some(address) => address.serialize(serializer),
        None => serializer.serialize_str(OFF),
    }
}
