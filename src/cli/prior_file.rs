//! A trained network given in place of the shipped one.

use std::path::{Path, PathBuf};

use super::exit::Failure;
use scpsfm_core::subspace::{self, PriorFile};

/// Which trained network to ask.
#[derive(Debug, Clone, clap::Args)]
pub struct PriorFileArgs {
    /// Ask this network, written by `scpsfm train-prior`, instead of the one that the program carries
    #[arg(long, value_name = "FILE")]
    pub prior: Option<PathBuf>,
}

impl PriorFileArgs {
    /// From now on, this process asks the network that was given.
    ///
    /// # Errors
    /// What is wrong with the file.
    pub fn install(&self) -> Result<(), Failure> {
        self.prior.as_deref().map_or(Ok(()), |path| install(path).map_err(Failure::bad_input))
    }
}

/// From now on, this process asks the network in a file; the error says what is wrong with it.
pub fn install(path: &Path) -> Result<(), String> {
    let named = |what: &dyn std::fmt::Display| format!("{}: {what}", path.display());
    let file = PriorFile::open(path).map_err(|what| named(&what))?;
    subspace::install(file).map_err(|_| named(&"another network was given before"))
}
