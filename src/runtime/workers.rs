//! A fixed pool of threads for the solves.

use std::slice::IterMut;
use std::sync::atomic::{AtomicBool, AtomicUsize, Ordering};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

use rayon::iter::{IndexedParallelIterator, IntoParallelIterator, IntoParallelRefIterator, ParallelIterator};

use crate::estimate::ensemble::{Batch, Parallel};

/// Members handed to a thread at a time when they are drawn: enough work to be worth the hand-over.
const CHUNK: usize = 12;

/// The pool.
pub struct Workers {
    pool: rayon::ThreadPool,
}

/// The pool could not be started.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error("cannot start {threads} worker threads: {reason}")]
pub struct WorkersError {
    threads: usize,
    reason: String,
}

impl Workers {
    /// Starts `threads` threads; 0 is one per core.
    ///
    /// # Errors
    /// When the system does not give the threads.
    pub fn start(threads: usize) -> Result<Self, WorkersError> {
        let pool = rayon::ThreadPoolBuilder::new()
            .num_threads(threads)
            .thread_name(|i| format!("solve-{i}"))
            .build()
            .map_err(|e| WorkersError { threads, reason: e.to_string() })?;
        Ok(Self { pool })
    }

    /// Number of threads.
    #[must_use]
    pub fn threads(&self) -> usize {
        self.pool.current_num_threads()
    }

    /// Runs `job` in this pool: from there, handing parts to the other threads is cheap.
    pub fn install<T: Send>(&self, job: impl FnOnce() -> T + Send) -> T {
        self.pool.install(job)
    }

    /// Runs `job` in this pool with all other threads awake and waiting for parts of it: those of a window are so short
    /// that a thread that sleeps would come too late. Meant for one job that is to be done as fast as the machine goes.
    pub fn concentrate<T: Send>(&self, job: impl FnOnce() -> T + Send) -> T {
        // Nothing that a waiting thread looks at lies near anything that a working one writes.
        let (awake, over) = (Arc::new(Alone(AtomicUsize::new(0))), Arc::new(Alone(AtomicBool::new(false))));
        let others = self.threads() - 1;
        self.pool.install(|| {
            rayon::scope(|scope| {
                let _end = OnDrop(Arc::clone(&over));
                for _ in 0..others {
                    let (awake, over) = (Arc::clone(&awake), Arc::clone(&over));
                    scope.spawn(move |_| keep_awake(&awake, &over));
                }
                // They must not be left to this thread, which would then wait for itself.
                while awake.0.load(Ordering::Relaxed) < others {
                    std::hint::spin_loop();
                }
                job()
            })
        })
    }

    /// Does `job` for every item, side by side; results in the order of the items.
    pub fn map<T: Sync, R: Send>(&self, items: &[T], job: impl Fn(&T) -> R + Send + Sync) -> Vec<R> {
        self.pool.install(|| items.par_iter().with_max_len(1).map(job).collect())
    }

    /// Runs `job` on some thread of the pool, some time.
    pub fn spawn(&self, job: impl FnOnce() + Send + 'static) {
        self.pool.spawn(job);
    }
}

/// With no neighbour in its lines of the cache: who waits for it would slow down whoever works beside it.
#[repr(align(128))]
struct Alone<T>(T);

fn keep_awake(awake: &Alone<AtomicUsize>, over: &Alone<AtomicBool>) {
    awake.0.fetch_add(1, Ordering::Relaxed);
    while !over.0.load(Ordering::Relaxed) {
        if rayon::yield_now() != Some(rayon::Yield::Executed) {
            std::hint::spin_loop();
        }
    }
}

/// Says so when it is over, also by a panic.
struct OnDrop(Arc<Alone<AtomicBool>>);

impl Drop for OnDrop {
    fn drop(&mut self) {
        self.0.0.store(true, Ordering::Relaxed);
    }
}

/// Whoever is free takes the next batch: most cost alike, but a member that needs the general solver costs as much as the
/// rest of its batch many times over. This thread takes them from the front and others from the back, so that most stay
/// in the cache that they are in. What is to be done beside is done first.
fn share_out(
    batches: &mut [Batch],
    threads: usize,
    job: &(dyn Fn(&mut Batch) + Sync),
    beside: &mut (dyn FnMut() + Send),
) {
    if threads < 2 {
        beside();
        batches.iter_mut().for_each(job);
        return;
    }
    let rest = Mutex::new(batches.iter_mut());
    // Functions of their own: the lock is not held while a job is done.
    let (first, last) = (|| lock(&rest).next(), || lock(&rest).next_back());
    let from_front = || {
        beside();
        while let Some(batch) = first() {
            job(batch);
        }
    };
    let from_back = || {
        while let Some(batch) = last() {
            job(batch);
        }
    };
    rayon::join(from_front, || side_by_side(threads - 1, &from_back));
}

/// No job is done while it is held, so that none can panic.
fn lock<'a, 'b>(rest: &'a Mutex<IterMut<'b, Batch>>) -> MutexGuard<'a, IterMut<'b, Batch>> {
    rest.lock().unwrap_or_else(PoisonError::into_inner)
}

fn side_by_side(threads: usize, work: &(dyn Fn() + Sync)) {
    if threads > 1 {
        rayon::join(work, || side_by_side(threads - 1, work));
    } else {
        work();
    }
}

impl Parallel for Workers {
    fn for_each_beside(
        &self,
        batches: &mut [Batch],
        job: &(dyn Fn(&mut Batch) + Sync),
        beside: &mut (dyn FnMut() + Send),
    ) {
        let threads = self.threads();
        if threads == 1 || self.pool.current_thread_index().is_some() {
            share_out(batches, threads, job, beside);
        } else {
            // From outside, the hand-over costs as much as a short window.
            self.pool.install(|| share_out(batches, threads, job, beside));
        }
    }

    fn both(&self, one: &mut (dyn FnMut() + Send), other: &mut (dyn FnMut() + Send)) {
        self.pool.install(|| rayon::join(one, other));
    }

    fn for_indices(&self, count: usize, job: &(dyn Fn(usize) + Sync)) {
        self.pool.install(|| (0..count).into_par_iter().with_min_len(CHUNK).for_each(job));
    }
}
