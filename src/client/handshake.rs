//! What went wrong with a TLS handshake, in words of what to do about it.

use std::error::Error as StdError;
use std::io;

use tokio_rustls::rustls::{self, AlertDescription, CertificateError};

use super::error::{Error, ErrorKind};
use super::options::Setting;

/// Why a connection to `server` could not be trusted; `None` for any other trouble.
pub(super) fn error(server: &str, error: &(dyn StdError + 'static)) -> Option<Error> {
    let mut cause = Some(error);
    while let Some(here) = cause {
        // What arrives after the handshake has gone through layers that keep no more than its text.
        let found = rustls_error(here).and_then(of_handshake).or_else(|| of_alert_text(&here.to_string()));
        if let Some((words, setting)) = found {
            return Some(Error { setting, ..ErrorKind::NotLetIn.error(format!("{server}: {words}")) });
        }
        cause = here.source();
    }
    None
}

/// What went wrong, and what would help.
type Found = (String, Option<Setting>);

/// rustls' own error, which an I/O error holds without calling it its source.
fn rustls_error<'a>(error: &'a (dyn StdError + 'static)) -> Option<&'a rustls::Error> {
    let inner = error.downcast_ref::<io::Error>().and_then(io::Error::get_ref);
    error.downcast_ref().or_else(|| inner?.downcast_ref())
}

fn of_handshake(error: &rustls::Error) -> Option<Found> {
    use CertificateError::{
        Expired, ExpiredContext, NotValidForName, NotValidForNameContext, NotValidYet, NotValidYetContext,
        UnknownIssuer,
    };
    let words = match error {
        rustls::Error::InvalidCertificate(UnknownIssuer) => {
            let words = "no authority that is trusted here has signed the server's certificate; `tls_ca` names others";
            return Some((words.into(), Some(Setting::TlsCa)));
        }
        rustls::Error::InvalidCertificate(NotValidForName | NotValidForNameContext { .. }) => {
            "the server's certificate is for another name than that of this address, which must use one of its names"
                .into()
        }
        rustls::Error::InvalidCertificate(
            Expired | ExpiredContext { .. } | NotValidYet | NotValidYetContext { .. },
        ) => "the server's certificate has expired or is not valid yet, or this machine's clock is wrong".into(),
        // What `openssl req -x509` makes when it is told nothing else; the error has no type of its own.
        rustls::Error::InvalidCertificate(other) if format!("{other:?}").contains("CaUsedAsEndEntity") => {
            "the server's certificate is one of an authority (CA:TRUE) and not of a server; make it with \
             basicConstraints=CA:FALSE"
                .into()
        }
        rustls::Error::InvalidCertificate(other) => format!("the server's certificate is not right: {other}"),
        rustls::Error::InvalidMessage(_) => "the server does not speak TLS there; http:// is for one without".into(),
        rustls::Error::AlertReceived(alert) => return Some(of_alert(*alert)),
        _ => return None,
    };
    Some((words, None))
}

fn of_alert(alert: AlertDescription) -> Found {
    match alert {
        AlertDescription::CertificateRequired => {
            let words = "the server asks for a client's certificate; `tls_cert` says which to show";
            (words.into(), Some(Setting::TlsCert))
        }
        AlertDescription::UnknownCA
        | AlertDescription::BadCertificate
        | AlertDescription::CertificateUnknown
        | AlertDescription::CertificateExpired
        | AlertDescription::DecryptError => {
            let words = format!("the server does not trust the client's certificate (`tls_cert`): {alert:?}");
            (words, Some(Setting::TlsCert))
        }
        other => (format!("the server broke off the TLS handshake: {other:?}"), None),
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
fn of_alert_text(text: &str) -> Option<Found> {
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
    Some(of_alert(alert))
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
        let setting = |cause: io::Error| error("https://a", &cause).map(|error| error.setting);
        let refused = rustls::Error::InvalidCertificate(CertificateError::UnknownIssuer);
        let wrapped = io::Error::new(io::ErrorKind::InvalidData, refused);
        assert_eq!(setting(wrapped), Some(Some(Setting::TlsCa)));
        // As text: what the transport makes of it later.
        let alert = rustls::Error::AlertReceived(AlertDescription::CertificateRequired).to_string();
        assert_eq!(setting(io::Error::other(alert)), Some(Some(Setting::TlsCert)));
        assert_eq!(setting(io::Error::other("connection refused")), None);
    }
}
