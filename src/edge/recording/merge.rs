//! Small parts of a folder become bigger ones.

use std::path::{Path, PathBuf};
use std::sync::mpsc::{Receiver, SyncSender, sync_channel};
use std::thread::JoinHandle;

use super::layout::{Part, Parts, remove};
use crate::edge::files::columnar::{Field, Reader, SCHEMA_KEY, UNITS_KEY, Writer};
use crate::edge::files::error::FileError;

/// Rows read at a time.
const BATCH: usize = 4096;

/// Merges that may wait; one that finds no place is asked for again later.
const QUEUE: usize = 4096;

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

/// A thread that merges, beside the one that records.
pub struct Merger {
    jobs: Option<SyncSender<Job>>,
    thread: Option<JoinHandle<()>>,
}

impl Merger {
    /// Starts it.
    ///
    /// # Errors
    /// When there is no thread to be had.
    pub fn start() -> std::io::Result<Self> {
        let (jobs, receiver) = sync_channel(QUEUE);
        let thread = std::thread::Builder::new().name("merge".to_owned()).spawn(move || work(&receiver))?;
        Ok(Self { jobs: Some(jobs), thread: Some(thread) })
    }

    /// Asks for a folder to be looked at; false if too many wait.
    #[must_use]
    pub fn ask(&self, job: Job) -> bool {
        self.jobs.as_ref().is_some_and(|jobs| jobs.try_send(job).is_ok())
    }
}

impl Drop for Merger {
    /// Finishes what is asked for.
    fn drop(&mut self) {
        self.jobs = None;
        if let Some(thread) = self.thread.take() {
            let _ = thread.join();
        }
    }
}

fn work(jobs: &Receiver<Job>) {
    for job in jobs {
        // Parts that stay small are read as well as big ones; what is wrong with the disk the recorder says.
        if let Err(error) = merge(&job) {
            tracing::warn!("parts are left unmerged: {error}");
        }
    }
}
