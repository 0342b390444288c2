//! Small parts of a folder become bigger ones.

use std::path::{Path, PathBuf};
use std::sync::mpsc::{Receiver, SyncSender, TryRecvError, sync_channel};
use std::thread::JoinHandle;

use super::layout::{Part, Parts, remove};
use crate::edge::files::columnar::{Field, Reader, SCHEMA_KEY, UNITS_KEY, Writer};
use crate::edge::files::error::FileError;

/// Rows read at a time.
const BATCH: usize = 4096;

/// Merges that may wait; one that finds no place is asked for again later.
const QUEUE: usize = 4096;

/// Old folders that are still tidied when no more is asked for: years of them are left to the next start.
const MAX_AT_END: usize = 256;

/// A folder to look at.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Job {
    /// Which one.
    pub folder: PathBuf,
    /// Whether all parts are merged, as the hour is over; else those that never were.
    pub all: bool,
}

/// Merges parts that follow each other and have the same columns: the bigger part gets its name first, and those that
/// it holds are removed then. A crash in between leaves leftovers and loses nothing.
///
/// # Errors
/// When a part is damaged or the folder cannot be written.
pub fn merge(job: &Job) -> Result<(), FileError> {
    let parts = Parts::of(&job.folder)?;
    parts.leftover.iter().try_for_each(|path| remove(path))?;
    let mut described = Vec::new();
    for part in parts.live {
        let fields = Reader::open(&part.path)?.fields().to_vec();
        described.push((part, fields));
    }
    let together = |a: &(Part, Vec<Field>), b: &(Part, Vec<Field>)| {
        a.1 == b.1 && (job.all || (a.0.is_single() && b.0.is_single()))
    };
    for run in described.chunk_by(together).filter(|run| run.len() > 1) {
        let parts: Vec<&Part> = run.iter().map(|(part, _)| part).collect();
        merge_run(&job.folder, &parts, &run[0].1)?;
    }
    Ok(())
}

fn merge_run(folder: &Path, parts: &[&Part], fields: &[Field]) -> Result<(), FileError> {
    let [first, .., last] = parts else { return Ok(()) };
    let about = Reader::open(&first.path)?;
    let own = |key: &str| key == SCHEMA_KEY || key == UNITS_KEY;
    let metadata: Vec<(&str, String)> =
        about.all_metadata().iter().filter(|(k, _)| !own(k)).map(|(k, v)| (k.as_str(), v.clone())).collect();
    let merged = Part::new(folder, first.first, last.last);
    let mut writer = Writer::create(&merged.path, fields.to_vec(), &metadata)?;
    for part in parts {
        let mut reader = Reader::open(&part.path)?;
        while let Some(batch) = reader.next_batch(BATCH)? {
            writer.batch(batch)?;
        }
    }
    writer.finish()?;
    parts.iter().try_for_each(|part| remove(&part.path))
}

/// Removes what an interruption left in a folder into which nobody writes any more, and merges all of its parts.
///
/// # Errors
/// When a part is damaged or the folder cannot be written.
pub fn tidy(folder: PathBuf) -> Result<(), FileError> {
    let parts = Parts::of(&folder)?;
    parts.clean()?;
    if parts.live.len() > 1 { merge(&Job { folder, all: true }) } else { Ok(()) }
}

/// A thread that merges, beside the one that records.
pub struct Merger {
    jobs: Option<SyncSender<Job>>,
    thread: Option<JoinHandle<()>>,
}

impl Merger {
    /// Starts it. Whenever nothing else is asked for, it [tidies](tidy) the next of these old folders.
    ///
    /// # Errors
    /// When there is no thread to be had.
    pub fn start(old: impl Iterator<Item = PathBuf> + Send + 'static) -> std::io::Result<Self> {
        let (jobs, receiver) = sync_channel(QUEUE);
        let thread = std::thread::Builder::new().name("merge".to_owned()).spawn(move || work(&receiver, old))?;
        Ok(Self { jobs: Some(jobs), thread: Some(thread) })
    }

    /// Asks for a folder to be looked at; false if too many wait.
    #[must_use]
    pub fn ask(&self, job: Job) -> bool {
        self.jobs.as_ref().is_some_and(|jobs| jobs.try_send(job).is_ok())
    }
}

impl Drop for Merger {
    /// Finishes what is asked for, and some of the old folders.
    fn drop(&mut self) {
        self.jobs = None;
        if let Some(thread) = self.thread.take() {
            let _ = thread.join();
        }
    }
}

fn work(jobs: &Receiver<Job>, old: impl Iterator<Item = PathBuf>) {
    let mut at_end = 0;
    for folder in old {
        at_end += usize::from(!merge_asked(jobs));
        if at_end > MAX_AT_END {
            return;
        }
        say(tidy(folder));
    }
    jobs.iter().for_each(|job| say(merge(&job)));
}

/// Merges what is asked for now; false if no more will be.
fn merge_asked(jobs: &Receiver<Job>) -> bool {
    loop {
        match jobs.try_recv() {
            Ok(job) => say(merge(&job)),
            Err(TryRecvError::Empty) => return true,
            Err(TryRecvError::Disconnected) => return false,
        }
    }
}

/// Parts that stay small are read as well as big ones; what is wrong with the disk the recorder says.
fn say(merged: Result<(), FileError>) {
    if let Err(error) = merged {
        tracing::warn!("parts are left unmerged: {error}");
    }
}
