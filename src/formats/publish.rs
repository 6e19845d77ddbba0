//! Putting files into a directory: each appears whole or not at all, and those of one run stand together or not at all.

use std::fs::{self, File};
use std::io::{self, Write};
use std::path::{Path, PathBuf};

use super::manifest::{self, Manifest, Written};

/// Creates a directory and what is above it.
///
/// # Errors
/// The directory cannot be created; the message names it.
pub fn create_directory(directory: &Path) -> io::Result<()> {
    fs::create_dir_all(directory)
        .map_err(|error| named(&error, &format!("cannot create the directory {}", directory.display())))
}

/// Writes a file under a temporary name and renames it, so that no reader sees half of it and a full disk leaves the
/// old one standing.
///
/// # Errors
/// The file cannot be written; the message names it.
pub fn write_atomically(directory: &Path, name: &str, bytes: &[u8]) -> io::Result<()> {
    TemporaryFile::write(&directory.join(name), bytes)?.rename()
}

/// JSON for people too: indented, with a newline at the end.
///
/// # Errors
/// A value that cannot be serialised.
pub fn pretty(value: &impl serde::Serialize) -> io::Result<String> {
    let mut text = serde_json::to_string_pretty(value).map_err(io::Error::other)?;
    text.push('\n');
    Ok(text)
}

/// Files of one run that are to stand together: all are on the disk before the first takes its name.
pub struct Draft<'a> {
    directory: &'a Path,
    /// What this run read, which may be files that a former one wrote: it stays.
    input: Option<&'a Path>,
    files: Vec<(Written, TemporaryFile)>,
}

impl<'a> Draft<'a> {
    /// Nothing yet; the directory is created.
    ///
    /// * `input`: what this run read, a file or the directory of several
    ///
    /// # Errors
    /// The directory cannot be created; the message names it.
    pub fn new(directory: &'a Path, input: Option<&'a Path>) -> io::Result<Self> {
        create_directory(directory)?;
        Ok(Self { directory, input, files: Vec::new() })
    }

    /// Writes a file under a temporary name; `path` is below the directory.
    ///
    /// # Errors
    /// The file cannot be written; the message names it.
    pub fn add(&mut self, path: impl AsRef<Path>, bytes: &[u8]) -> io::Result<()> {
        let target = self.directory.join(&path);
        if let Some(folder) = target.parent() {
            create_directory(folder)?;
        }
        self.files.push((Written::new(path.as_ref(), bytes), TemporaryFile::write(&target, bytes)?));
        Ok(())
    }

    /// Lets `write` make a file under a temporary name, as a program does that needs a file to work on; `path` is below
    /// the directory. What it says is wrong is returned, and then there is no file.
    ///
    /// # Errors
    /// The file cannot be read back or brought to the disk; the message names it.
    pub fn add_with<E>(
        &mut self,
        path: impl AsRef<Path>,
        write: impl FnOnce(&Path) -> Result<(), E>,
    ) -> io::Result<Result<(), E>> {
        let target = self.directory.join(&path);
        if let Some(folder) = target.parent() {
            create_directory(folder)?;
        }
        let file = TemporaryFile::of(&target);
        if let Err(what) = write(&file.temporary) {
            drop(file);
            self.remove_empty_folders(&target);
            return Ok(Err(what));
        }
        let finished = || {
            File::open(&file.temporary)?.sync_all()?;
            Written::of_file(path.as_ref(), &file.temporary)
        };
        let written = finished().map_err(|error| file.failed(&error))?;
        self.files.push((written, file));
        Ok(Ok(()))
    }

    /// Gives the files their names and takes away what a former run left beside them, as far as it still is what that
    /// run wrote. The file that says that the others are there, `last`, goes before any other changes, and comes last.
    ///
    /// # Errors
    /// The first file that cannot be written or removed, named.
    pub fn publish(mut self, last: &str, bytes: &[u8]) -> io::Result<()> {
        let former = Manifest::read(self.directory);
        self.add(last, bytes)?;
        // Before the first is renamed: a run that cannot end leaves the former one whole.
        if let Some((_, file)) = self.files.iter().find(|(_, file)| file.target.is_dir()) {
            return Err(file.failed(&io::Error::from(io::ErrorKind::IsADirectory)));
        }
        let own: Vec<Written> = self.files.iter().map(|(written, _)| written.clone()).collect();
        // Until all is in its place both are listed: wherever this ends, the next run knows what is there.
        let both = former.files.iter().filter(|file| !own.contains(file)).chain(&own).cloned().collect();
        self.list(&Manifest { last: former.last.clone(), files: both })?;
        let former_mark = former.files.iter().find(|file| file.path() == former.last && file.stands(self.directory));
        let marks =
            former_mark.and_then(|file| file.place(self.directory)).into_iter().chain([self.directory.join(last)]);
        for mark in marks {
            remove(&mark)?;
        }
        self.sync();
        let replaced: Vec<PathBuf> = self.files.iter().map(|(_, file)| file.target.clone()).collect();
        let complete = self.files.pop();
        for (_, file) in self.files.drain(..) {
            file.rename()?;
        }
        for place in former.removable(self.directory, &replaced).into_iter().filter(|place| !self.was_read(place)) {
            self.take_away(&place)?;
        }
        self.list(&Manifest { last: last.to_owned(), files: own })?;
        self.sync();
        complete.map_or(Ok(()), |(_, file)| file.rename())
    }

    fn list(&self, manifest: &Manifest) -> io::Result<()> {
        write_atomically(self.directory, manifest::NAME, pretty(manifest)?.as_bytes())
    }

    /// Brings the names of the directory to the disk in the order in which they were given, as far as the system can.
    fn sync(&self) {
        // Where a directory cannot be opened as a file there is nothing to be done, and the files themselves are
        // synced.
        let _ = File::open(self.directory).and_then(|directory| directory.sync_all());
    }

    /// Whether it is, or lies in, what this run read.
    fn was_read(&self, place: &Path) -> bool {
        let resolved = |path: &Path| path.canonicalize().ok();
        let Some(input) = self.input.and_then(resolved) else { return false };
        [Some(place), place.parent()].into_iter().flatten().any(|place| resolved(place).as_ref() == Some(&input))
    }

    /// Removes a file, and the folders below the directory that are empty then.
    fn take_away(&self, place: &Path) -> io::Result<()> {
        remove(place)?;
        self.remove_empty_folders(place);
        Ok(())
    }

    fn remove_empty_folders(&self, place: &Path) {
        for folder in place.ancestors().skip(1).take_while(|folder| *folder != self.directory) {
            // What is not empty holds files that are not ours.
            if fs::remove_dir(folder).is_err() {
                break;
            }
        }
    }
}

/// A file that is on the disk under a temporary name, and is removed when dropped; after the rename there is nothing
/// left to remove.
struct TemporaryFile {
    temporary: PathBuf,
    target: PathBuf,
}

impl TemporaryFile {
    /// One that is still to be written.
    fn of(target: &Path) -> Self {
        let name = target.file_name().unwrap_or_default().to_string_lossy();
        let temporary = target.with_file_name(format!(".{name}.{}", std::process::id()));
        Self { temporary, target: target.to_owned() }
    }

    fn write(target: &Path, bytes: &[u8]) -> io::Result<Self> {
        let file = Self::of(target);
        let attempt = || {
            let mut open = File::create(&file.temporary)?;
            open.write_all(bytes)?;
            open.sync_all()
        };
        attempt().map_err(|error| file.failed(&error))?;
        Ok(file)
    }

    fn rename(self) -> io::Result<()> {
        fs::rename(&self.temporary, &self.target).map_err(|error| self.failed(&error))
    }

    fn failed(&self, error: &io::Error) -> io::Error {
        named(error, &format!("cannot write {}", self.target.display()))
    }
}

impl Drop for TemporaryFile {
    fn drop(&mut self) {
        let _ = fs::remove_file(&self.temporary);
    }
}

/// Removes a file if it is there; the message of a failure names it.
fn remove(file: &Path) -> io::Result<()> {
    match fs::remove_file(file) {
        Err(error) if !matches!(error.kind(), io::ErrorKind::NotFound | io::ErrorKind::NotADirectory) => {
            Err(named(&error, &format!("cannot remove {}", file.display())))
        }
        _ => Ok(()),
    }
}

fn named(error: &io::Error, what: &str) -> io::Error {
    io::Error::new(error.kind(), format!("{what}: {error}"))
}
