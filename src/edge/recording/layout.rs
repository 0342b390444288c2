//! Folders and names of a recording.

use std::collections::BTreeSet;
use std::fmt::Write as _;
use std::path::{Path, PathBuf};

use crate::edge::files::error::FileError;
use crate::edge::files::whole::is_unfinished;
use crate::estimate::time::NS_PER_S;

/// Longest name of a bed after escaping: file systems allow 255 bytes with `bed=` before it.
const MAX_NAME: usize = 240;

/// A name of a bed as a folder: everything but letters, digits, `-`, `_` and `.` as `%XX`, as Hive does. None if it is
/// empty or too long.
#[must_use]
pub fn escape(name: &str) -> Option<String> {
    let mut escaped = String::new();
    for byte in name.bytes() {
        if byte.is_ascii_alphanumeric() || matches!(byte, b'-' | b'_' | b'.') {
            escaped.push(char::from(byte));
        } else {
            // Writing to a string cannot fail.
            let _ = write!(escaped, "%{byte:02X}");
        }
    }
    (!escaped.is_empty() && escaped.len() <= MAX_NAME).then_some(escaped)
}

/// The name that was escaped; None if it was not.
#[must_use]
pub fn unescape(escaped: &str) -> Option<String> {
    let mut bytes = Vec::new();
    let mut rest = escaped.bytes();
    while let Some(byte) = rest.next() {
        if byte == b'%' {
            let digits = [rest.next()?, rest.next()?];
            bytes.push(u8::from_str_radix(std::str::from_utf8(&digits).ok()?, 16).ok()?);
        } else {
            bytes.push(byte);
        }
    }
    String::from_utf8(bytes).ok()
}

/// The hour of a unix time \[ns\], UTC, as `YYYY-MM-DDTHH`.
#[must_use]
pub fn hour(unix_ns: i64) -> String {
    let hours = unix_ns.div_euclid(3600 * NS_PER_S);
    let (days, hour) = (hours.div_euclid(24), hours.rem_euclid(24));
    let (year, month, day) = date(days);
    format!("{year:04}-{month:02}-{day:02}T{hour:02}")
}

/// Year, month and day of the Gregorian calendar, from days since 1970-01-01. Years begin in March here, so that the day
/// that some of them have more is their last.
fn date(days: i64) -> (i64, i64, i64) {
    let since_year_0 = days + 719_468;
    let (era, day) = (since_year_0.div_euclid(146_097), since_year_0.rem_euclid(146_097));
    let year = (day - day / 1460 + day / 36_524 - day / 146_096) / 365;
    let day_of_year = day - (365 * year + year / 4 - year / 100);
    let month = (5 * day_of_year + 2) / 153;
    let day_of_month = day_of_year - (153 * month + 2) / 5 + 1;
    let (month, next) = if month < 10 { (month + 3, 0) } else { (month - 9, 1) };
    (era * 400 + year + next, month, day_of_month)
}

/// Folder of a table, bed (escaped) and hour.
#[must_use]
pub fn folder(recording: &Path, table: &str, bed: &str, hour: &str) -> PathBuf {
    hour_folder(&recording.join(table).join(format!("bed={bed}")), hour)
}

/// Folder of an hour, in that of a bed.
#[must_use]
pub fn hour_folder(bed: &Path, hour: &str) -> PathBuf {
    bed.join(format!("hour={hour}"))
}

/// A file of a folder, and which parts it holds.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Part {
    /// The first one.
    pub first: u64,
    /// The last one; the same if nothing was merged.
    pub last: u64,
    /// The file.
    pub path: PathBuf,
}

impl Part {
    /// A part of a folder.
    #[must_use]
    pub fn new(folder: &Path, first: u64, last: u64) -> Self {
        let name = if first == last {
            format!("part-{first:06}.parquet")
        } else {
            format!("part-{first:06}-{last:06}.parquet")
        };
        Self { first, last, path: folder.join(name) }
    }

    fn of(folder: &Path, name: &str) -> Option<Self> {
        let numbers = name.strip_prefix("part-")?.strip_suffix(".parquet")?;
        let (first, last) = numbers.split_once('-').unwrap_or((numbers, numbers));
        let part = Self::new(folder, first.parse().ok()?, last.parse().ok()?);
        (part.first <= part.last && part.path.ends_with(name)).then_some(part)
    }

    /// Whether it was not merged.
    #[must_use]
    pub fn is_single(&self) -> bool {
        self.first == self.last
    }
}

/// The parts of a folder.
#[derive(Debug, Default, PartialEq, Eq)]
pub struct Parts {
    /// In order; together they hold every row once.
    pub live: Vec<Part>,
    /// What merged parts hold as well.
    pub leftover: Vec<PathBuf>,
    /// What was never finished.
    pub unfinished: Vec<PathBuf>,
}

impl Parts {
    /// Lists a folder; one that does not exist has none.
    ///
    /// # Errors
    /// When it cannot be read.
    pub fn of(folder: &Path) -> Result<Self, FileError> {
        let (mut parts, mut found) = (Self::default(), Vec::new());
        for name in names(folder)? {
            if is_unfinished(&name) {
                parts.unfinished.push(folder.join(name));
            } else {
                found.extend(Part::of(folder, &name));
            }
        }
        // The widest first where several begin together, so that what is covered comes after what covers it.
        found.sort_by_key(|part| (part.first, u64::MAX - part.last));
        for part in found {
            match parts.live.last() {
                Some(before) if part.last <= before.last => parts.leftover.push(part.path),
                _ => parts.live.push(part),
            }
        }
        Ok(parts)
    }

    /// The number that the next part gets.
    #[must_use]
    pub fn next(&self) -> u64 {
        self.live.last().map_or(0, |part| part.last + 1)
    }

    /// Removes leftovers, and what was never finished.
    ///
    /// # Errors
    /// When they cannot be removed.
    pub fn clean(&self) -> Result<(), FileError> {
        self.leftover.iter().chain(&self.unfinished).try_for_each(|path| remove(path))
    }
}

/// Removes a file; it may be gone already.
pub(super) fn remove(path: &Path) -> Result<(), FileError> {
    match std::fs::remove_file(path) {
        Err(error) if error.kind() != std::io::ErrorKind::NotFound => Err(FileError::file(path, &error)),
        _ => Ok(()),
    }
}

/// Names in a folder, in order; none if it does not exist.
fn names(folder: &Path) -> Result<BTreeSet<String>, FileError> {
    let failed = |error: std::io::Error| FileError::file(folder, &error);
    let entries = match std::fs::read_dir(folder) {
        Err(error) if error.kind() == std::io::ErrorKind::NotFound => return Ok(BTreeSet::new()),
        entries => entries.map_err(failed)?,
    };
    // A name that is no text is none of ours.
    let name = |entry: std::io::Result<std::fs::DirEntry>| entry.map(|e| e.file_name().into_string().ok());
    Ok(entries.map(name).collect::<Result<Vec<_>, _>>().map_err(failed)?.into_iter().flatten().collect())
}

/// Beds of a table: names, and how their folders are called.
///
/// # Errors
/// When the folder cannot be read.
pub fn beds(recording: &Path, table: &str) -> Result<Vec<(String, PathBuf)>, FileError> {
    let folder = recording.join(table);
    let bed = |name: &String| Some((unescape(name.strip_prefix("bed=")?)?, folder.join(name)));
    Ok(names(&folder)?.iter().filter_map(bed).collect())
}

/// Folders of the hours of a bed, in order.
///
/// # Errors
/// When the folder cannot be read.
pub fn hours(bed: &Path) -> Result<Vec<PathBuf>, FileError> {
    Ok(names(bed)?.iter().filter(|name| name.starts_with("hour=")).map(|name| bed.join(name)).collect())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names_of_beds_stay_within_their_folder_and_come_back() {
        for (name, escaped) in [
            ("bed1", "bed1"),
            ("icu-7_b.2", "icu-7_b.2"),
            ("a b/c\\..", "a%20b%2Fc%5C.."),
            ("Größe=%41", "Gr%C3%B6%C3%9Fe%3D%2541"),
        ] {
            assert_eq!(escape(name).as_deref(), Some(escaped));
            assert_eq!(unescape(escaped).as_deref(), Some(name));
        }
        assert_eq!((escape(""), escape(&"ä".repeat(41))), (None, None));
        assert_eq!((unescape("%4"), unescape("%zz"), unescape("%ff")), (None, None, None));
    }

    #[test]
    fn hours_are_those_of_the_calendar() {
        let s = NS_PER_S;
        for (ns, expected) in [
            (0, "1970-01-01T00"),
            (-1, "1969-12-31T23"),
            (951_782_399 * s + 999_999_999, "2000-02-28T23"),
            (951_868_799 * s, "2000-02-29T23"),
            (951_868_800 * s, "2000-03-01T00"),
            (1_767_225_599 * s, "2025-12-31T23"),
            (4_107_542_400 * s, "2100-03-01T00"),
        ] {
            assert_eq!(hour(ns), expected, "{ns}");
        }
    }

    #[test]
    fn a_part_within_the_range_of_another_is_a_leftover() {
        let folder = tempfile::tempdir().unwrap();
        let folder = folder.path();
        let names = ["part-000000-000002", "part-000001", "part-000002", "part-000003", "part-000004-000009"];
        for name in names.map(|n| format!("{n}.parquet")).iter().map(String::as_str).chain([
            ".part-000010.parquet.tmp",
            "part-1.parquet",
            "part-000009-000001.parquet",
            "notes.txt",
        ]) {
            std::fs::write(folder.join(name), "").unwrap();
        }
        let parts = Parts::of(folder).unwrap();
        let live: Vec<(u64, u64)> = parts.live.iter().map(|p| (p.first, p.last)).collect();
        assert_eq!(live, [(0, 2), (3, 3), (4, 9)]);
        assert_eq!((parts.leftover.len(), parts.unfinished.len(), parts.next()), (2, 1, 10));
        parts.clean().unwrap();
        assert_eq!(Parts::of(folder).unwrap(), Parts { live: parts.live, ..Parts::default() });
        assert_eq!(Parts::of(&folder.join("none")).unwrap(), Parts::default());
    }
}
