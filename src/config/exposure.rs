//! Which addresses a server may listen on, by what keeps unauthenticated callers out.

use std::net::SocketAddr;

use super::http::Http;
use super::sections::{Auth, Server, Tls};

/// A port that others than this machine could reach, without enough to keep them out; says what to do.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum Exposed {
    #[error(
        "{0}: {1} is open to a network, and neither TLS nor keys keep strangers out; right would be \
         tls.certificate and tls.key (--tls-certificate, --tls-key) with auth.keys_file (--keys-file), a loopback address \
         such as 127.0.0.1, or, where the network itself lets in only whom you trust, server.insecure = true \
         (--insecure)"
    )]
    Open(&'static str, SocketAddr),
    #[error(
        "{0}: {1} is open to a network, and without TLS the keys would travel readable; right would be \
         tls.certificate and tls.key (--tls-certificate, --tls-key), a loopback address such as 127.0.0.1, or, \
         behind a proxy that ends TLS, server.plaintext_keys = true (--plaintext-keys)"
    )]
    ReadableKeys(&'static str, SocketAddr),
}

/// Whether the server may listen where it is told to.
///
/// Loopback is always right. Elsewhere, TLS is; anything less must be asked for by name, each by its own, so that the
/// word that once allowed a test without keys never sends keys in the clear.
///
/// # Errors
/// [`Exposed`].
pub fn check(server: &Server, http: &Http, tls: &Tls, auth: &Auth) -> Result<(), Exposed> {
    let ports = [("server.listen", Some(server.listen)), ("http.listen", http.listen)];
    let plain = tls.certificate.is_none();
    for (key, listen) in ports {
        let Some(listen) = listen.filter(|listen| !listen.ip().to_canonical().is_loopback()) else { continue };
        match auth.is_on() {
            true if plain && !server.plaintext_keys => return Err(Exposed::ReadableKeys(key, listen)),
            false if plain && !server.insecure => return Err(Exposed::Open(key, listen)),
            _ => {}
        }
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn only_loopback_is_open_to_anyone_unless_told_so_by_name() {
        let verdict = |listen: &str, tls: bool, keys: bool, word: &str| {
            let listen = listen.parse().expect("an address");
            let server = Server {
                listen,
                insecure: word == "insecure",
                plaintext_keys: word == "plaintext_keys",
                ..Server::default()
            };
            let file = || Some("f".into());
            let tls = if tls { Tls { certificate: file(), key: file(), client_ca: None } } else { Tls::default() };
            let auth = Auth { keys_file: keys.then(|| "f".into()), keys: None };
            let verdict = check(&server, &Http::default(), &tls, &auth);
            // The port for HTTP is held to the same.
            let http = Http { listen: Some(listen), ..Http::default() };
            let local = Server { listen: Server::default().listen, ..server };
            let of_http = check(&local, &http, &tls, &auth);
            let is_open = |verdict: Result<(), Exposed>| verdict.map_err(|error| matches!(error, Exposed::Open(..)));
            assert_eq!(is_open(of_http), is_open(verdict.clone()), "{listen}");
            is_open(verdict)
        };
        for local in ["127.0.0.1:1", "127.9.9.9:0", "[::1]:1", "[::ffff:127.0.0.1]:1"] {
            for keys in [false, true] {
                assert_eq!(verdict(local, false, keys, ""), Ok(()), "{local}");
            }
        }
        for open in ["0.0.0.0:1", "[::]:1", "10.0.0.1:1", "[::ffff:10.0.0.1]:1"] {
            assert_eq!(verdict(open, false, false, ""), Err(true), "{open}");
            assert_eq!(verdict(open, false, false, "plaintext_keys"), Err(true), "{open}");
            assert_eq!(verdict(open, false, false, "insecure"), Ok(()), "{open}");
            assert_eq!(verdict(open, false, true, ""), Err(false), "{open}");
            assert_eq!(verdict(open, false, true, "insecure"), Err(false), "{open}");
            assert_eq!(verdict(open, false, true, "plaintext_keys"), Ok(()), "{open}");
            for keys in [false, true] {
                assert_eq!(verdict(open, true, keys, ""), Ok(()), "{open}");
            }
        }
    }
}
