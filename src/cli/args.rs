//! Arguments that several commands share.

use std::ops::RangeInclusive;
use std::str::FromStr;

use clap::Args;

use super::access::AccessArgs;
use super::exit::Failure;
use super::shell::quoted;
use crate::client::{Client, MAX_WAIT};
use crate::parallel::Threads;

/// Where the server listens by default; `serve --listen` has the same port.
pub const DEFAULT_SERVER: &str = "http://127.0.0.1:50051";

/// Which server to talk to.
#[derive(Debug, Clone, Args)]
pub struct ServerArgs {
    /// Address of the server, http:// or https://
    #[arg(long, value_name = "URL", env = "SCPSFM_SERVER", hide_env_values = true, default_value = DEFAULT_SERVER)]
    pub server: String,

    #[command(flatten)]
    pub access: AccessArgs,
}

impl ServerArgs {
    /// The flags with which another command reaches the same server in the same way, each with a space before it.
    pub fn flags(&self) -> String {
        format!(" --server {}{}", quoted(&self.server), self.access.flags())
    }

    /// Connects to it; where a call has to wait, it is told on stderr.
    ///
    /// # Errors
    /// See [`Client::connect`].
    pub async fn connect(&self) -> Result<Client, Failure> {
        let mut client = Client::connect(&self.server, &self.access.options()?).await?;
        client.on_wait(|trouble| tell!("waiting up to {} s: {trouble}", MAX_WAIT.as_secs()));
        Ok(client)
    }
}

/// A whole number, with an error that says what it is not.
///
/// # Errors
/// For anything else.
pub fn parse_whole<T: FromStr>(text: &str) -> Result<T, String> {
    text.parse().map_err(|_| {
        let digits = !text.is_empty() && text.bytes().all(|byte| byte.is_ascii_digit());
        if digits { "is too large a number".into() } else { "is not a whole number >= 0".into() }
    })
}

/// The same within a range.
///
/// # Errors
/// For anything else.
pub fn parse_within(range: RangeInclusive<u64>) -> impl Fn(&str) -> Result<u64, String> + Clone {
    move |text| match parse_whole(text)? {
        number if range.contains(&number) => Ok(number),
        _ => Err(format!("is not in {range:?}")),
    }
}

/// Which page of a list.
#[derive(Debug, Clone, Args)]
pub struct PageArgs {
    /// Entries in a page
    #[arg(long, value_name = "N", default_value_t = 50, value_parser = clap::value_parser!(u16).range(1..=1000))]
    pub page_size: u16,

    /// The page that follows another
    #[arg(long, value_name = "TOKEN", default_value = "")]
    pub page_token: String,

    /// Every page from there on
    #[arg(long)]
    pub all: bool,
}

impl PageArgs {
    /// Goes on to the page after one, where it is wanted; says on stderr how to ask for it, where it is not.
    pub fn next(&mut self, next_page_token: String) -> bool {
        if next_page_token.is_empty() {
            return false;
        }
        if !self.all {
            tell!("more: --page-token {next_page_token}");
        }
        self.page_token = next_page_token;
        self.all
    }
}

/// A number above 0.
pub fn parse_positive(text: &str) -> Result<f64, String> {
    let number = text.parse::<f64>().map_err(|_| "is not a number".to_owned())?;
    if number.is_finite() && number > 0.0 { Ok(number) } else { Err("is not positive and finite".into()) }
}

/// A number within a range.
///
/// # Errors
/// For anything else.
pub fn parse_number_within((least, most): (f64, f64)) -> impl Fn(&str) -> Result<f64, String> + Clone {
    move |text| match text.parse() {
        Ok(number) if (least..=most).contains(&number) => Ok(number),
        Ok(_) => Err(format!("is not in {least:e}..={most:e}")),
        Err(_) => Err("is not a number".to_owned()),
    }
}

/// Threads that solve at a time where nothing is said: one a core.
pub fn cores() -> usize {
    Threads::one_a_core().count()
}
