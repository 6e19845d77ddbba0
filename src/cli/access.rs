//! The flags on the access to a server.

use std::fmt::Display;
use std::path::PathBuf;

use clap::parser::ValueSource;
use clap::{Arg, ArgMatches, Args, Command, FromArgMatches};

use super::exit::Failure;
use super::shell::quoted;
use crate::client::{ApiKey, Options, Setting};

/// The variable that may hold the API key. No flag does: other users of the machine see flags.
const KEY_VARIABLE: &str = "SCPSFM_API_KEY";

/// Heading of the flags that say who calls. Given flag by flag: set for the whole, it would go on to flags of the
/// command.
const ACCESS: &str = "Access to the server";

/// Who calls, and whom to trust.
#[derive(Debug, Clone, Default, Args)]
pub struct AccessArgs {
    #[command(flatten)]
    pub tenant: TenantArg,

    /// File with the API key; without it, the variable SCPSFM_API_KEY
    #[arg(long, help_heading = ACCESS, value_name = "FILE")]
    pub api_key_file: Option<PathBuf>,

    /// Authorities that the server's certificate must lead to (PEM) [default: those of the system]
    #[arg(long, help_heading = ACCESS, value_name = "FILE")]
    pub tls_ca: Option<PathBuf>,

    /// Certificate to show to a server that asks for one (PEM)
    #[arg(long, help_heading = ACCESS, value_name = "FILE", requires = "tls_key")]
    pub tls_cert: Option<PathBuf>,

    /// Private key of that certificate (PEM)
    #[arg(long, help_heading = ACCESS, value_name = "FILE", requires = "tls_cert")]
    pub tls_key: Option<PathBuf>,

    /// Send the API key to another machine without TLS: whoever listens in has it
    #[arg(long, help_heading = ACCESS)]
    pub plaintext_keys: bool,
}

impl AccessArgs {
    /// The flags that were given, each with a space before it. What came from variables is there for the next command,
    /// too.
    pub fn flags(&self) -> String {
        let files = [
            ("--api-key-file", &self.api_key_file),
            ("--tls-ca", &self.tls_ca),
            ("--tls-cert", &self.tls_cert),
            ("--tls-key", &self.tls_key),
        ];
        let mut flags = String::new();
        if let Some(tenant) = self.tenant.flag() {
            flags.push_str(&format!(" --tenant {}", quoted(tenant)));
        }
        for (flag, file) in files {
            if let Some(file) = file {
                flags.push_str(&format!(" {flag} {}", quoted(&file.to_string_lossy())));
            }
        }
        if self.plaintext_keys {
            flags.push_str(" --plaintext-keys");
        }
        flags
    }

    /// Whether anything was said that has no meaning without a server.
    pub fn is_given(&self) -> bool {
        !self.flags().is_empty()
    }

    /// The tenant as names have it: `-` is that of the key.
    ///
    /// # Errors
    /// For what is no tenant's id, and a key that cannot be read, as wrong usage.
    pub fn tenant(&self) -> Result<String, Failure> {
        Ok(self.options()?.tenant()?.to_owned())
    }

    /// The same for the client.
    ///
    /// # Errors
    /// For a key that cannot be read or is none, as wrong usage.
    pub fn options(&self) -> Result<Options, Failure> {
        Ok(Options {
            tenant: self.tenant.id.clone(),
            api_key: self.api_key()?,
            tls_ca: self.tls_ca.clone(),
            tls_cert: self.tls_cert.clone(),
            tls_key: self.tls_key.clone(),
            plaintext_keys: self.plaintext_keys,
        })
    }

    /// The key, from the file or the environment.
    fn api_key(&self) -> Result<Option<ApiKey>, Failure> {
        let (source, text) = match &self.api_key_file {
            Some(path) => {
                let source = format!("--api-key-file: {}", path.display());
                let text = std::fs::read_to_string(path);
                (source.clone(), text.map_err(|error| Failure::usage(format_args!("{source}: {error}")))?)
            }
            None => match std::env::var(KEY_VARIABLE) {
                Ok(text) if !text.is_empty() => (KEY_VARIABLE.to_owned(), text),
                Err(std::env::VarError::NotUnicode(_)) => {
                    return Err(Failure::usage(format_args!("{KEY_VARIABLE} holds no text")));
                }
                _ => return Ok(None),
            },
        };
        let key = ApiKey::new(text.trim());
        key.map(Some).map_err(|error| Failure::usage(with_name(&error.message, Setting::ApiKey, &source)))
    }
}

/// Whose jobs these are. A variable is a default, which a name that has a tenant replaces; a flag is not, and where the
/// two differ one of them is a slip.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct TenantArg {
    /// `None`: that of the key.
    pub id: Option<String>,
    pub is_flag: bool,
}

impl TenantArg {
    pub const ID: &str = "tenant";

    /// What the flag says.
    pub fn flag(&self) -> Option<&str> {
        self.id.as_deref().filter(|_| self.is_flag)
    }

    /// Refuses a full name of another tenant than that of the flag.
    ///
    /// # Errors
    /// As wrong usage.
    pub fn check(&self, tenant: &str, name: &impl Display) -> Result<(), Failure> {
        match self.flag() {
            Some(flag) if flag != tenant => Err(Failure::usage(format_args!(
                "--tenant {flag}: {name} is of the tenant {tenant}; leave one of the two out"
            ))),
            _ => Ok(()),
        }
    }
}

impl Args for TenantArg {
    fn augment_args(command: Command) -> Command {
        let help = "Tenant of the jobs; beside this flag, not the variable, a full name of another tenant is refused \
                    [default: that of the API key; without a key `default`]";
        let arg = Arg::new(Self::ID).long(Self::ID).help_heading(ACCESS).value_name("ID").env("SCPSFM_TENANT");
        command.arg(arg.help(help))
    }

    fn augment_args_for_update(command: Command) -> Command {
        Self::augment_args(command)
    }
}

impl FromArgMatches for TenantArg {
    fn from_arg_matches(matches: &ArgMatches) -> Result<Self, clap::Error> {
        Ok(Self {
            id: matches.get_one::<String>(Self::ID).cloned(),
            is_flag: matches.value_source(Self::ID) == Some(ValueSource::CommandLine),
        })
    }

    fn update_from_arg_matches(&mut self, matches: &ArgMatches) -> Result<(), clap::Error> {
        *self = Self::from_arg_matches(matches)?;
        Ok(())
    }
}

/// Where a setting comes from on the command line.
fn flag(setting: Setting) -> &'static str {
    match setting {
        Setting::Server => "--server",
        Setting::Tenant => "--tenant or SCPSFM_TENANT",
        Setting::ApiKey => "--api-key-file or SCPSFM_API_KEY",
        Setting::TlsCa => "--tls-ca",
        Setting::TlsCert => "--tls-cert",
        Setting::TlsKey => "--tls-key",
        Setting::PlaintextKeys => "--plaintext-keys",
    }
}

/// A message of the client with the flag in the place of its setting.
pub fn with_flag(message: &str, setting: Setting) -> String {
    with_name(message, setting, flag(setting))
}

fn with_name(message: &str, setting: Setting, name: &str) -> String {
    message.replacen(&format!("`{}`", setting.name()), name, 1)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::cli::exit::Exit;

    #[test]
    fn a_file_without_a_key_is_named_and_its_content_is_not() {
        let directory = tempfile::tempdir().expect("a temporary directory");
        let path = directory.path().join("key");
        std::fs::write(&path, "hunter2\n").expect("written");
        let access = AccessArgs { api_key_file: Some(path.clone()), ..AccessArgs::default() };
        let failure = access.options().expect_err("too short");
        assert_eq!(failure.exit, Exit::Usage);
        let begin = format!("--api-key-file: {} has a key of fewer than", path.display());
        assert!(failure.message.starts_with(&begin) && !failure.message.contains("hunter2"), "{failure}");
    }

    #[test]
    fn the_flags_that_were_given_are_told_again() {
        let args = |words: &[&str]| {
            let command = AccessArgs::augment_args(Command::new("test"));
            let matches = command.try_get_matches_from([&["test"], words].concat()).expect("flags");
            AccessArgs::from_arg_matches(&matches).expect("flags")
        };
        assert_eq!(args(&[]).flags(), "");
        let tls = ["--tls-ca", "ca.pem", "--tls-cert", "c.pem", "--tls-key", "k.pem"];
        let all = [&["--tenant", "north", "--api-key-file", "a key"], &tls[..], &["--plaintext-keys"]].concat();
        let told = args(&all).flags();
        assert_eq!(told, format!(" --tenant north --api-key-file 'a key' {} --plaintext-keys", tls.join(" ")));
        let tenant = TenantArg { id: Some("north".into()), is_flag: false };
        assert_eq!(AccessArgs { tenant, ..AccessArgs::default() }.flags(), "", "the variable is still there");
        assert!(args(&["--tenant", "north"]).is_given() && !args(&[]).is_given());
    }

    #[test]
    fn what_is_no_tenant_is_told_by_its_flag() {
        let tenant = TenantArg { id: Some("North".into()), is_flag: true };
        let access = AccessArgs { tenant, ..AccessArgs::default() };
        let failure = access.tenant().expect_err("capitals");
        assert_eq!(failure.exit, Exit::Usage);
        assert!(failure.message.starts_with("--tenant or SCPSFM_TENANT \"North\" is not"), "{failure}");
    }
}
