//! The configuration's file as a source whose errors show its path as the user gave it: the one of the `config` crate
//! shows it from the working directory.

use std::path::{Path, PathBuf};

use config::{ConfigError, FileFormat, Format, Map, Source, Value};

/// A TOML file.
#[derive(Debug, Clone)]
pub struct TomlFile(PathBuf);

impl TomlFile {
    pub fn new(path: &Path) -> Self {
        Self(path.to_path_buf())
    }
}

impl Source for TomlFile {
    fn clone_into_box(&self) -> Box<dyn Source + Send + Sync> {
        Box::new(self.clone())
    }

    fn collect(&self) -> Result<Map<String, Value>, ConfigError> {
        let path = self.0.display().to_string();
        let text = std::fs::read_to_string(&self.0)
            .map_err(|error| ConfigError::Message(format!("cannot read {path}: {error}")))?;
        // Some editors begin a file with a byte order mark.
        let text = text.strip_prefix('\u{feff}').unwrap_or(&text);
        let parsed = FileFormat::Toml.parse(Some(&path), text);
        parsed.map_err(|cause| ConfigError::FileParse { uri: Some(path), cause })
    }
}
