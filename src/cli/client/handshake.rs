//! What went wrong with a TLS handshake, in words of what to do about it.

use std::error::Error;
use std::io;

use tokio_rustls::rustls::{self, AlertDescription, CertificateError};

/// Why a connection to `server` could not be trusted; `None` for any other trouble.
pub(super) fn words(server: &str, error: &(dyn Error + 'static)) -> Option<String> {
    let mut cause = Some(error);
    while let Some(here) = cause {
        if let Some(words) = rustls_error(here).and_then(|error| of_handshake(server, error)) {
            return Some(words);
        }
        // What arrives after the handshake has gone through layers that keep no more than its text.
        if let Some(words) = of_alert_text(server, &here.to_string()) {
            return Some(words);
        }
        cause = here.source();
    }
    None
}

/// rustls' own error, which an I/O error holds without calling it its source.
fn rustls_error<'a>(error: &'a (dyn Error + 'static)) -> Option<&'a rustls::Error> {
    let inner = error.downcast_ref::<io::Error>().and_then(io::Error::get_ref);
    error.downcast_ref().or_else(|| inner?.downcast_ref())
}

fn of_handshake(server: &str, error: &rustls::Error) -> Option<String> {
    use CertificateError::{
        Expired, ExpiredContext, NotValidForName, NotValidForNameContext, NotValidYet, NotValidYetContext,
        UnknownIssuer,
    };
    let text = match error {
        rustls::Error::InvalidCertificate(UnknownIssuer) => format!(
            "{server}: no authority that is trusted here has signed the server's certificate; --tls-ca FILE names others"
        ),
        rustls::Error::InvalidCertificate(NotValidForName | NotValidForNameContext { .. }) => format!(
            "{server}: the server's certificate is for another name than that of this address; --server must use one of \
             its names"
        ),
        rustls::Error::InvalidCertificate(
            Expired | ExpiredContext { .. } | NotValidYet | NotValidYetContext { .. },
        ) => {
            format!(
                "{server}: the server's certificate has expired or is not valid yet, or this machine's clock is wrong"
            )
        }
        // What `openssl req -x509` makes when it is told nothing else; the error has no type of its own.
        rustls::Error::InvalidCertificate(other) if format!("{other:?}").contains("CaUsedAsEndEntity") => format!(
            "{server}: the server's certificate is one of an authority (CA:TRUE) and not of a server; make it with \
             basicConstraints=CA:FALSE"
        ),
        rustls::Error::InvalidCertificate(other) => format!("{server}: the server's certificate is not right: {other}"),
        rustls::Error::InvalidMessage(_) => {
            format!("{server}: the server does not speak TLS there; http:// is for one without")
        }
        rustls::Error::AlertReceived(alert) => of_alert(server, *alert),
        _ => return None,
    };
    Some(text)
}

fn of_alert(server: &str, alert: AlertDescription) -> String {
    match alert {
        AlertDescription::CertificateRequired => {
            format!("{server}: the server asks for a client's certificate: --tls-cert and --tls-key")
        }
        AlertDescription::UnknownCA
        | AlertDescription::BadCertificate
        | AlertDescription::CertificateUnknown
        | AlertDescription::CertificateExpired
        | AlertDescription::DecryptError => {
            format!("{server}: the server does not trust the client's certificate (--tls-cert): {alert:?}")
        }
        other => format!("{server}: the server broke off the TLS handshake: {other:?}"),
    }
}

/// What may be wrong with the address, where a connection without TLS broke as it does at a server with TLS, or at one
/// that speaks something else: its first words read as a frame of HTTP/2 that is too long, or the server closes before
/// the call is written.
pub(super) fn plain_hint(server: &str, cause: &str) -> &'static str {
    let like_it = ["frame with invalid size", "broken pipe"].iter().any(|text| cause.contains(text));
    match server.starts_with("http://") && like_it {
        true => "; does it speak TLS, at https://, or is this another port than that of gRPC?",
        false => "",
    }
}

/// Alerts whose text may come without their type, as rustls writes them.
fn of_alert_text(server: &str, text: &str) -> Option<String> {
    let (_, alert) = text.split_once("received fatal alert: ")?;
    let known = [
        AlertDescription::CertificateRequired,
        AlertDescription::UnknownCA,
        AlertDescription::BadCertificate,
        AlertDescription::CertificateUnknown,
        AlertDescription::CertificateExpired,
        AlertDescription::DecryptError,
    ];
    let alert = known.into_iter().find(|known| alert.contains(&format!("{known:?}")))?;
    Some(of_alert(server, alert))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_missing_https_is_asked_for_where_it_may_be_the_cause() {
        assert!(plain_hint("http://a", "frame with invalid size").contains("https://"));
        assert!(plain_hint("http://a", "stream closed because of a broken pipe").contains("https://"));
        assert_eq!(plain_hint("https://a", "frame with invalid size"), "");
        assert_eq!(plain_hint("http://a", "connection refused"), "");
    }

    #[test]
    fn an_error_is_found_wherever_it_is_wrapped() {
        let refused = rustls::Error::InvalidCertificate(CertificateError::UnknownIssuer);
        let wrapped = io::Error::new(io::ErrorKind::InvalidData, refused);
        assert!(words("https://a", &wrapped).is_some_and(|words| words.contains("--tls-ca")));
        // As text: what the transport makes of it later.
        let alert = rustls::Error::AlertReceived(AlertDescription::CertificateRequired).to_string();
        assert!(words("https://a", &io::Error::other(alert)).is_some_and(|words| words.contains("--tls-cert ")));
        assert_eq!(words("https://a", &io::Error::other("connection refused")), None);
    }
}
