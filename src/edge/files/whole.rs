//! A file that is whole as soon as it has its name.

use std::ffi::OsString;
use std::fs::File;
use std::io::{self, Write};
use std::path::{Path, PathBuf};

use super::error::FileError;

/// How names of unfinished files end.
const UNFINISHED: &str = ".tmp";

/// Written beside its place as `.NAME.tmp`, forced to the disk and renamed when finished; removed if it is
/// given up, left as it is if the program is killed.
///
/// The name begins with a dot because readers of folders (pyarrow, DuckDB, pandas) pass over such files: a folder stays
/// readable while one is written and after a crash.
#[derive(Debug)]
pub struct WholeFile {
    path: PathBuf,
    temporary: PathBuf,
    file: File,
    finished: bool,
}

impl WholeFile {
    /// Begins the file; what has its name stays until it is finished.
    ///
    /// # Errors
    /// When the path names no file or its folder cannot be written.
    pub fn create(path: &Path) -> Result<Self, FileError> {
        let Some(name) = path.file_name() else {
            return Err(FileError::content(path, None, "no name of a file", "FOLDER/NAME"));
        };
        let mut hidden = OsString::from(".");
        hidden.push(name);
        hidden.push(UNFINISHED);
        let temporary = path.with_file_name(hidden);
        let file = File::create(&temporary).map_err(|e| FileError::file(path, &e))?;
        Ok(Self { path: path.to_owned(), temporary, file, finished: false })
    }

    /// Where it will be.
    #[must_use]
    pub fn path(&self) -> &Path {
        &self.path
    }

    /// Forces it to the disk and gives it its name; returns its size \[bytes\].
    ///
    /// # Errors
    /// When the disk refuses either.
    pub fn finish(mut self) -> Result<u64, FileError> {
        let size = self.file.sync_all().and_then(|()| self.file.metadata()).map(|about| about.len());
        let named = size.and_then(|size| std::fs::rename(&self.temporary, &self.path).map(|()| size));
        let size = named.map_err(|e| FileError::file(&self.path, &e))?;
        self.finished = true;
        sync_folder(&self.path)?;
        Ok(size)
    }
}

impl Write for WholeFile {
    fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
        self.file.write(bytes)
    }

    fn flush(&mut self) -> io::Result<()> {
        self.file.flush()
    }
}

impl Drop for WholeFile {
    fn drop(&mut self) {
        if !self.finished {
            // What is left over is removed by whoever cleans the folder next.
            let _ = std::fs::remove_file(&self.temporary);
        }
    }
}

/// Where text goes: into a file that is whole as soon as it has its name, or into what has that name already and is no
/// file of its own, such as a pipe, a device or a link, which is written to as it is.
#[derive(Debug)]
pub enum Destination {
    /// A file.
    Whole(WholeFile),
    /// Something else.
    Other(File),
}

impl Destination {
    /// Begins the file, or opens what is there.
    ///
    /// # Errors
    /// When it cannot be written, or the path names no file.
    pub fn create(path: &Path) -> Result<Self, FileError> {
        if path.symlink_metadata().is_ok_and(|about| !about.is_file()) {
            return File::create(path).map(Self::Other).map_err(|e| FileError::file(path, &e));
        }
        WholeFile::create(path).map(Self::Whole)
    }

    /// Gives the file its name.
    ///
    /// # Errors
    /// When the disk refuses it.
    pub fn finish(self) -> Result<(), FileError> {
        match self {
            Self::Whole(file) => file.finish().map(|_| ()),
            Self::Other(_) => Ok(()),
        }
    }
}

impl Write for Destination {
    fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
        match self {
            Self::Whole(file) => file.write(bytes),
            Self::Other(file) => file.write(bytes),
        }
    }

    fn flush(&mut self) -> io::Result<()> {
        match self {
            Self::Whole(file) => file.flush(),
            Self::Other(file) => file.flush(),
        }
    }
}

/// Whether a name is that of a file that was never finished.
#[must_use]
pub fn is_unfinished(name: &str) -> bool {
    name.starts_with('.') && name.ends_with(UNFINISHED)
}

/// Forces the names in the folder of a file to the disk: a rename outlives a power failure only then.
pub(in crate::edge) fn sync_folder(path: &Path) -> Result<(), FileError> {
    // Other systems do not open folders.
    if cfg!(unix) {
        let folder = path.parent().filter(|p| !p.as_os_str().is_empty()).unwrap_or(Path::new("."));
        File::open(folder).and_then(|f| f.sync_all()).map_err(|e| FileError::file(folder, &e))?;
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_name_appears_with_everything_in_it_or_not_at_all() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("a.bin");
        std::fs::write(&path, "old").unwrap();
        let mut file = WholeFile::create(&path).unwrap();
        file.write_all(b"new").unwrap();
        assert_eq!(std::fs::read(&path).unwrap(), b"old");
        assert!(is_unfinished(".a.bin.tmp") && folder.path().join(".a.bin.tmp").exists());
        file.finish().unwrap();
        assert_eq!(std::fs::read(&path).unwrap(), b"new");

        let mut given_up = WholeFile::create(&path).unwrap();
        given_up.write_all(b"half").unwrap();
        drop(given_up);
        assert_eq!(std::fs::read(&path).unwrap(), b"new");
        assert_eq!(std::fs::read_dir(folder.path()).unwrap().count(), 1);
        let nowhere = WholeFile::create(&folder.path().join("none/a.bin")).unwrap_err().to_string();
        assert!(nowhere.contains("none/a.bin: No such file"), "{nowhere}");
    }

    #[cfg(unix)]
    #[test]
    fn what_is_no_file_of_its_own_is_written_to_as_it_is() {
        let folder = tempfile::tempdir().unwrap();
        let [file, link, null] = ["a.csv", "link.csv", "null.csv"].map(|name| folder.path().join(name));
        std::os::unix::fs::symlink(&file, &link).unwrap();
        std::os::unix::fs::symlink("/dev/null", &null).unwrap();
        for path in [&file, &link, &null] {
            let mut destination = Destination::create(path).unwrap();
            destination.write_all(path.as_os_str().as_encoded_bytes()).unwrap();
            assert_eq!(matches!(destination, Destination::Whole(_)), *path == file);
            destination.finish().unwrap();
        }
        assert_eq!(std::fs::read(&file).unwrap(), link.as_os_str().as_encoded_bytes());
        assert!(link.is_symlink() && null.is_symlink());
        assert_eq!(std::fs::read_dir(folder.path()).unwrap().count(), 3);
        assert!(Destination::create(folder.path()).is_err());
    }
}
