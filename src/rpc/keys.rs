//! API keys: which tenant a key stands for, and what it allows. Only hashes are kept.
//!
//! A key is random and long, so that its plain SHA-256 gives nothing away and needs neither salt nor stretching.

use std::collections::BTreeSet;
use std::fmt;
use std::path::{Path, PathBuf};
use std::str::FromStr;

use serde::{Deserialize, Deserializer};
use sha2::{Digest as _, Sha256};
use subtle::ConstantTimeEq;

use crate::domain::job::{DEFAULT_TENANT, JobName};

/// Shortest key: 128 random bits in hexadecimal. Anything shorter could be guessed from its hash.
const MIN_KEY_CHARS: usize = 32;

/// Longest key: well above what any generator makes, well below what a header may hold.
const MAX_KEY_CHARS: usize = 256;

/// Of a key's hash in logs: the keys of a server are too few for two to share these.
const FINGERPRINT_BYTES: usize = 4;

/// Before the hash of a key that is not written itself.
const HASHED: &str = "sha256:";

/// What an entry looks like, for errors.
const FORM: &str = "TENANT:[SCOPE:]KEY or TENANT:[SCOPE:]sha256:HEX";

/// What is kept of a key: its SHA-256.
#[derive(Clone, PartialEq, Eq, Hash)]
pub struct Hash([u8; 32]);

impl Hash {
    pub fn of(key: &str) -> Self {
        Self(Sha256::digest(key).into())
    }

    /// The first digits of the key's SHA-256, for logs: enough to find its line in a file of keys, and no way back.
    pub fn fingerprint(&self) -> String {
        self.0[..FINGERPRINT_BYTES].iter().map(|byte| format!("{byte:02x}")).collect()
    }
}

scpsfm_core::named! {
    /// What a key allows. Each scope allows what those before it do.
    #[derive(PartialOrd, Ord)]
    pub enum Scope {
        /// Calls that change nothing.
        ReadOnly = "read-only",
        /// Every call on the tenant's own jobs and inputs.
        Ordinary = "ordinary",
        /// The administration, and every call on the jobs and inputs of all tenants.
        Admin = "admin",
    }
}

/// What a key stands for.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Grant {
    pub tenant: String,
    pub scope: Scope,
}

impl Default for Grant {
    /// Everyone's where nobody needs a key.
    fn default() -> Self {
        Self { tenant: DEFAULT_TENANT.into(), scope: Scope::Ordinary }
    }
}

/// Keys and what they stand for.
#[derive(Clone, Default, PartialEq, Eq)]
pub struct KeyRing {
    keys: Vec<(Hash, Grant)>,
}

/// An entry that is none. Says where it stands and what would be right, and nothing of what it holds.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum Error {
    #[error("entry {entry} {problem}; right would be {FORM}")]
    Entry { entry: usize, problem: &'static str },
    #[error("entries {first} and {second} have the same key: a key stands for one tenant and one scope")]
    Repeated { first: usize, second: usize },
    #[error("there is no key in it; right would be lines {FORM}")]
    Empty,
}

impl KeyRing {
    /// Reads a file of keys, which may hold none.
    ///
    /// # Errors
    /// A sentence that names the file, and the entry by its number.
    pub fn read(path: &Path) -> Result<Self, String> {
        let text = std::fs::read_to_string(path).map_err(|error| format!("{}: {error}", path.display()))?;
        Self::parse(&text).map_err(|error| format!("{}: {error}", path.display()))
    }

    /// Entries on lines of their own or separated by commas; `#` begins a comment.
    fn parse(text: &str) -> Result<Self, Error> {
        let lines = text.lines().map(|line| line.split_once('#').map_or(line, |(entry, _)| entry));
        let entries = lines.flat_map(|line| line.split(',')).map(str::trim).filter(|entry| !entry.is_empty());
        let mut keys: Vec<(Hash, Grant)> = Vec::new();
        for (k, entry) in entries.enumerate() {
            let parsed = parse(entry).map_err(|problem| Error::Entry { entry: k + 1, problem })?;
            if let Some(first) = keys.iter().position(|(known, _)| *known == parsed.0) {
                return Err(Error::Repeated { first: first + 1, second: k + 1 });
            }
            keys.push(parsed);
        }
        Ok(Self { keys })
    }

    /// The keys of both.
    pub fn with(mut self, other: &Self) -> Self {
        self.keys.extend(other.keys.iter().cloned());
        self
    }

    /// What the key of this hash stands for. Compares with every key, each to its last byte, so that the time tells
    /// nothing.
    pub fn grant_of_hash(&self, key: &Hash) -> Option<&Grant> {
        let mut found = None;
        for (known, grant) in &self.keys {
            if bool::from(known.0.ct_eq(&key.0)) {
                found = Some(grant);
            }
        }
        found
    }

    /// How many keys there are.
    pub fn len(&self) -> usize {
        self.keys.len()
    }

    pub fn is_empty(&self) -> bool {
        self.keys.is_empty()
    }
}

impl FromStr for KeyRing {
    type Err = Error;

    /// The keys of a configuration, of which there is one at least: see [`KeyRing::parse`] for their form.
    fn from_str(text: &str) -> Result<Self, Error> {
        let ring = Self::parse(text)?;
        if ring.is_empty() { Err(Error::Empty) } else { Ok(ring) }
    }
}

fn parse(entry: &str) -> Result<(Hash, Grant), &'static str> {
    let (tenant, key) = entry.split_once(':').ok_or("has no tenant")?;
    // No key contains a colon.
    let (scope, key) = match key.split_once(':') {
        Some((word, rest)) if format!("{word}:") != HASHED => {
            (Scope::from_name(word).ok_or("has a scope that is not read-only, ordinary or admin")?, rest)
        }
        _ => (Scope::Ordinary, key),
    };
    if !JobName::is_id(tenant) {
        return Err("has a tenant that is not 1 to 63 of a-z, 0-9 and -, or begins or ends with -");
    }
    let hash = match key.strip_prefix(HASHED) {
        Some(hex) => from_hex(hex).ok_or("has a hash that is not 64 hexadecimal digits")?,
        None => Hash::of(checked(key)?),
    };
    Ok((hash, Grant { tenant: tenant.to_owned(), scope }))
}

/// A key, if it is one: what a bearer token may hold (RFC 6750, section 2.1).
///
/// # Errors
/// What is wrong with it, in words that go on after "the key" or "entry 3".
pub fn checked(key: &str) -> Result<&str, &'static str> {
    if !key.bytes().all(|byte| byte.is_ascii_alphanumeric() || b"-._~+/=".contains(&byte)) {
        return Err("has a key with other characters than letters, digits and -._~+/=");
    }
    match key.len() {
        ..MIN_KEY_CHARS => Err("has a key of fewer than 32 characters"),
        MIN_KEY_CHARS..=MAX_KEY_CHARS => Ok(key),
        _ => Err("has a key of more than 256 characters"),
    }
}

fn from_hex(text: &str) -> Option<Hash> {
    if text.len() != 64 || !text.bytes().all(|byte| byte.is_ascii_hexdigit()) {
        return None;
    }
    let half = |digits: &str| u128::from_str_radix(digits, 16).ok().map(u128::to_be_bytes);
    let halves = [half(&text[..32])?, half(&text[32..])?];
    halves.as_flattened().try_into().ok().map(Hash)
}

impl fmt::Debug for KeyRing {
    /// Tenants, no hashes.
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let tenants: BTreeSet<_> = self.keys.iter().map(|(_, grant)| grant.tenant.as_str()).collect();
        write!(f, "KeyRing({} keys of {tenants:?})", self.keys.len())
    }
}

impl<'de> Deserialize<'de> for KeyRing {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        String::deserialize(deserializer)?.parse().map_err(serde::de::Error::custom)
    }
}

/// Where keys come from.
#[derive(Debug, Clone, Default)]
pub struct Sources {
    /// Read again when it changes.
    pub file: Option<PathBuf>,
    pub fixed: Option<KeyRing>,
}

impl Sources {
    /// Whether there are any: then every caller needs a key.
    pub fn is_on(&self) -> bool {
        self.file.is_some() || self.fixed.is_some()
    }

    /// Every key there is now: none where the file lost its last one, which locks everyone out.
    ///
    /// # Errors
    /// See [`KeyRing::read`]; a key that the two give to different tenants or scopes.
    pub fn load(&self) -> Result<KeyRing, String> {
        let ring = self.file.as_deref().map(KeyRing::read).transpose()?.unwrap_or_default();
        let Some(fixed) = &self.fixed else { return Ok(ring) };
        let disputed =
            |(hash, grant): &(Hash, Grant)| fixed.keys.iter().any(|(other, of)| other == hash && of != grant);
        match ring.keys.iter().any(disputed) {
            true => Err("auth.keys and auth.keys_file give one key to two tenants or two scopes".into()),
            false => Ok(ring.with(fixed)),
        }
    }

    /// The keys of a server that starts: without any it is not what its configuration means.
    ///
    /// # Errors
    /// See [`Sources::load`]; no key at all.
    pub fn load_some(&self) -> Result<KeyRing, String> {
        match (self.load()?, &self.file) {
            (ring, Some(path)) if ring.is_empty() => Err(format!("{}: {}", path.display(), Error::Empty)),
            (ring, _) => Ok(ring),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const A: &str = "aaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaa";
    const B: &str = "bbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbb";

    impl KeyRing {
        /// The tenant that a key stands for.
        pub(crate) fn tenant_of(&self, key: &str) -> Option<&str> {
            self.grant_of_hash(&Hash::of(key)).map(|grant| grant.tenant.as_str())
        }
    }

    #[test]
    fn a_key_stands_for_its_tenant_however_it_is_written() {
        let hash = Hash::of(B).0.map(|byte| format!("{byte:02x}")).concat();
        let text = format!("# tenants\nnorth:{A} # the first\n\nsouth:sha256:{hash}\n");
        let ring: KeyRing = text.parse().expect("two keys");
        assert_eq!((ring.tenant_of(A), ring.tenant_of(B)), (Some("north"), Some("south")));
        for wrong in ["", "a", &hash, &format!("{A}a"), &A[1..], "north"] {
            assert_eq!(ring.tenant_of(wrong), None, "{wrong}");
        }
        let commas: KeyRing = format!("north:{A}, south:{B}").parse().expect("two keys");
        assert_eq!(commas, ring);
        let debug = format!("{ring:?}");
        assert_eq!(debug, "KeyRing(2 keys of {\"north\", \"south\"})");
    }

    #[test]
    fn a_scope_stands_between_tenant_and_key() {
        let hash = Hash::of(B).0.map(|byte| format!("{byte:02x}")).concat();
        let scope = |entry: &str, key: &str| {
            let ring: KeyRing = entry.parse().expect(entry);
            ring.grant_of_hash(&Hash::of(key)).map(|grant| (grant.tenant.clone(), grant.scope))
        };
        let north = |scope| Some(("north".to_owned(), scope));
        assert_eq!(scope(&format!("north:{A}"), A), north(Scope::Ordinary));
        for of in Scope::ALL {
            assert_eq!(scope(&format!("north:{}:{A}", of.name()), A), north(of));
            assert_eq!(scope(&format!("north:{}:sha256:{hash}", of.name()), B), north(of));
        }
        assert!(Scope::ALL.is_sorted(), "each allows what those before it do");
    }

    #[test]
    fn file_and_environment_add_up_and_do_not_dispute_a_key() {
        let directory = tempfile::tempdir().expect("a temporary directory");
        let path = directory.path().join("keys.txt");
        std::fs::write(&path, format!("north:{A}\n")).expect("written");
        let load = |fixed: &str| {
            let fixed = Some(fixed.parse().expect("keys"));
            Sources { file: Some(path.clone()), fixed }.load()
        };
        let both = load(&format!("south:{B},north:{A}")).expect("no dispute");
        assert_eq!((both.tenant_of(A), both.tenant_of(B)), (Some("north"), Some("south")));
        for other in [format!("south:{A}"), format!("north:admin:{A}")] {
            let error = load(&other).expect_err("disputed");
            assert!(error.contains("two tenants") && !error.contains(A), "{error}");
        }
        // A file without keys adds none, and is no beginning where there is nothing else.
        std::fs::write(&path, "# none\n").expect("written");
        assert_eq!(load(&format!("south:{B}")).expect("one key").tenant_of(B), Some("south"));
        let alone = Sources { file: Some(path.clone()), fixed: None };
        assert!(alone.load().expect("no key").is_empty());
        let error = alone.load_some().expect_err("no key");
        assert!(error.contains("keys.txt") && error.contains("no key"), "{error}");
    }

    #[test]
    fn the_hash_of_a_key_is_its_sha256() {
        // FIPS 180-4, of "abc".
        let expected = from_hex("ba7816bf8f01cfea414140de5dae2223b00361a396177a9cb410ff61f20015ad");
        assert!(Some(Hash::of("abc")) == expected);
    }

    #[test]
    fn what_is_no_key_is_named_by_its_place_and_not_repeated() {
        let short = "hunter2hunter2";
        let cases = [
            (format!("north:{A}\n{B}\n"), "entry 2 has no tenant"),
            (format!("North:{A}"), "entry 1 has a tenant"),
            (format!("north:{short}"), "fewer than 32"),
            (format!("north:{}", short.repeat(30)), "more than 256"),
            (format!("north:{A} {short}"), "other characters"),
            (format!("north:sha256:{A}"), "64 hexadecimal digits"),
            (format!("north:root:{A}"), "has a scope"),
            (format!("north:admin:{short}"), "fewer than 32"),
            (format!("north:admin:{A},north:{A}"), "entries 1 and 2"),
            (format!("north:{A},south:{B},west:{A}"), "entries 1 and 3"),
            ("# none\n".to_owned(), "no key"),
        ];
        for (text, part) in cases {
            let message = text.parse::<KeyRing>().expect_err(part).to_string();
            assert!(message.contains(part), "{message}");
            for secret in [A, B, short] {
                assert!(!message.contains(secret), "{message}");
            }
        }
    }
}
