//! The event loop: beds appear, take turns on the worker pool, and report.

use std::collections::{BTreeMap, VecDeque};
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::Duration;

use tokio::sync::mpsc;

use super::bed::{Bed, Health, Task};
use super::clock::Clock;
use super::workers::Workers;
use crate::estimate::estimator::{Estimator, Output};
use crate::estimate::settings::{EstimatorSettings, SettingsError};
use crate::estimate::time::ArrivalTime;
use crate::model::discrepancy::Circulation;

/// How often beds without input are told that time has passed.
const TICK: Duration = Duration::from_millis(20);

/// Tasks a worker does for one bed before other beds get their turn.
const TURN: usize = 64;

/// Everything that can happen to the service.
pub enum Event {
    /// A task for a bed, new or known.
    Task {
        /// Name of the bed.
        bed: String,
        /// What to do.
        task: Task,
    },
    /// A worker gives a bed back.
    Done(Box<Bed>),
    /// A worker lost a bed to a defect in the program.
    Lost(String),
    /// Stop after what is waiting is done.
    Stop,
}

/// Where outputs go. Called on worker threads.
pub trait Sink: Send + Sync {
    /// What a bed put out, in order, and how it goes if that was asked.
    fn put(&self, bed: &Bed, outputs: &[Output], health: Option<&Health>);

    /// Whether somebody wants the whole ensemble of a bed.
    fn wants_members(&self, bed: &str) -> bool;

    /// A bed was lost and starts anew.
    fn lost(&self, bed: &str);
}

/// Limits of the service.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Limits {
    /// Beds kept; messages of others are counted and dropped.
    pub max_beds: usize,
    /// Tasks waiting per bed.
    pub queue_tasks: usize,
    /// Time between reports.
    pub report_every: Duration,
}

/// Puts events in, without blocking; clones share the queue.
#[derive(Clone)]
pub struct Inlet {
    events: mpsc::Sender<Event>,
    dropped: Arc<AtomicU64>,
}

impl Inlet {
    /// Offers an event; if the queue is full it is dropped and counted.
    pub fn offer(&self, event: Event) {
        if self.events.try_send(event).is_err() {
            self.dropped.fetch_add(1, Ordering::Relaxed);
        }
    }

    /// Events dropped so far.
    #[must_use]
    pub fn dropped(&self) -> u64 {
        self.dropped.load(Ordering::Relaxed)
    }

    /// Waits for a place in the queue to ask the service to stop.
    pub async fn stop(&self) {
        // A closed queue means that it has stopped already.
        let _ = self.events.send(Event::Stop).await;
    }
}

/// A place in the table of beds.
struct Slot {
    /// None while a worker has it.
    bed: Option<Box<Bed>>,
    waiting: VecDeque<(Task, ArrivalTime)>,
    queue_full: u64,
    /// When it last had something to do.
    touched: ArrivalTime,
}

/// The service.
pub struct Service {
    model: Circulation,
    settings: EstimatorSettings,
    limits: Limits,
    workers: Arc<Workers>,
    sink: Arc<dyn Sink>,
    clock: Clock,
    events: mpsc::Receiver<Event>,
    returns: mpsc::UnboundedSender<Event>,
    returned: mpsc::UnboundedReceiver<Event>,
    beds: BTreeMap<String, Slot>,
    too_many_beds: u64,
    /// Events that did not fit into the queue, counted by the inlet.
    dropped: Arc<AtomicU64>,
}

impl Service {
    /// A service without beds, and the way in.
    ///
    /// # Errors
    /// When no estimator can be made of the settings.
    pub fn new(
        model: Circulation,
        settings: EstimatorSettings,
        limits: Limits,
        workers: Arc<Workers>,
        sink: Arc<dyn Sink>,
        clock: Clock,
    ) -> Result<(Self, Inlet), SettingsError> {
        Estimator::new(model.clone(), settings.clone())?;
        let (sender, events) = mpsc::channel(limits.queue_tasks.saturating_mul(16).clamp(1024, 65_536));
        // Unbounded in type only: there is at most one return per bed.
        let (returns, returned) = mpsc::unbounded_channel();
        let inlet = Inlet { events: sender, dropped: Arc::default() };
        let service = Self {
            model,
            settings,
            limits,
            workers,
            sink,
            clock,
            events,
            returns,
            returned,
            beds: BTreeMap::new(),
            too_many_beds: 0,
            dropped: Arc::clone(&inlet.dropped),
        };
        Ok((service, inlet))
    }

    /// Runs until it is told to stop; what is waiting then is still done.
    pub async fn run(mut self) {
        let mut tick = tokio::time::interval(TICK);
        tick.set_missed_tick_behavior(tokio::time::MissedTickBehavior::Skip);
        let mut report = tokio::time::interval(self.limits.report_every);
        report.set_missed_tick_behavior(tokio::time::MissedTickBehavior::Skip);
        let mut stopping = false;
        while !(stopping && self.is_idle()) {
            tokio::select! {
                biased;
                Some(event) = self.returned.recv() => self.take_back(event),
                Some(event) = self.events.recv(), if !stopping => match event {
                    Event::Task { bed, task } => self.enqueue(&bed, task),
                    Event::Stop => {
                        stopping = true;
                        self.report();
                    }
                    event @ (Event::Done(_) | Event::Lost(_)) => self.take_back(event),
                },
                _ = tick.tick(), if !stopping => self.tick(),
                _ = report.tick(), if !stopping => self.report(),
                else => break,
            }
        }
    }

    fn is_idle(&self) -> bool {
        self.beds.values().all(|slot| slot.bed.is_some() && slot.waiting.is_empty())
    }

    fn take_back(&mut self, event: Event) {
        match event {
            Event::Done(bed) => {
                let name = bed.name.clone();
                if let Some(slot) = self.beds.get_mut(&name) {
                    slot.bed = Some(bed);
                }
                self.dispatch(&name);
            }
            Event::Lost(name) => {
                self.sink.lost(&name);
                let bed = self.new_bed(&name);
                if let (Some(slot), Some(bed)) = (self.beds.get_mut(&name), bed) {
                    slot.bed = Some(bed);
                    slot.waiting.clear();
                }
            }
            Event::Task { .. } | Event::Stop => {}
        }
    }

    fn new_bed(&self, name: &str) -> Option<Box<Bed>> {
        let estimator = Estimator::new(self.model.clone(), self.settings.clone()).ok()?;
        Some(Box::new(Bed::new(name.to_owned(), estimator, self.clock)))
    }

    fn enqueue(&mut self, name: &str, task: Task) {
        let now = self.clock.now();
        if !self.beds.contains_key(name) {
            // What nobody understands makes no bed.
            if let Task::Refused(cause) = task {
                tracing::warn!(bed = name, cause, "a message for an unknown bed was not understood");
                return;
            }
            if self.beds.len() >= self.limits.max_beds {
                self.too_many_beds += 1;
                if self.too_many_beds.is_power_of_two() {
                    tracing::warn!(bed = name, max_beds = self.limits.max_beds, "bed refused: too many beds");
                }
                return;
            }
            let Some(bed) = self.new_bed(name) else { return };
            tracing::info!(bed = name, "new bed");
            let slot = Slot { bed: Some(bed), waiting: VecDeque::new(), queue_full: 0, touched: now };
            self.beds.insert(name.to_owned(), slot);
        }
        let limit = self.limits.queue_tasks;
        if let Some(slot) = self.beds.get_mut(name) {
            if slot.waiting.len() >= limit {
                slot.queue_full += 1;
            } else {
                slot.waiting.push_back((task, now));
                slot.touched = now;
            }
        }
        self.dispatch(name);
    }

    /// Hands a bed that is here and has something to do to a worker.
    fn dispatch(&mut self, name: &str) {
        let Some(slot) = self.beds.get_mut(name) else { return };
        if slot.waiting.is_empty() {
            return;
        }
        let Some(mut bed) = slot.bed.take() else { return };
        let tasks: Vec<_> = slot.waiting.drain(..slot.waiting.len().min(TURN)).collect();
        let (workers, sink, returns) = (Arc::clone(&self.workers), Arc::clone(&self.sink), self.returns.clone());
        let name = name.to_owned();
        self.workers.spawn(move || {
            let work = AssertUnwindSafe(|| {
                work_through(&mut bed, tasks, &workers, sink.as_ref());
                bed
            });
            // A defect in one bed must not take the others with it.
            let event = catch_unwind(work).map_or_else(|_| Event::Lost(name), Event::Done);
            // Let go before the bed is back: when the service has stopped, nobody is left who still publishes.
            drop((workers, sink));
            let _ = returns.send(event);
        });
    }

    fn tick(&mut self) {
        let now = self.clock.now();
        let period = i64::try_from(TICK.as_nanos()).unwrap_or(i64::MAX);
        let idle = |slot: &Slot| slot.waiting.is_empty() && now.ns_since(slot.touched) >= period;
        let due: Vec<String> = self.beds.iter().filter(|(_, slot)| idle(slot)).map(|(name, _)| name.clone()).collect();
        for name in due {
            self.enqueue(&name, Task::Tick);
        }
    }

    fn report(&mut self) {
        let names: Vec<String> = self.beds.keys().cloned().collect();
        for name in names {
            let Some((queue_depth, queue_full)) = self.beds.get(&name).map(|s| (s.waiting.len(), s.queue_full)) else {
                continue;
            };
            let want_members = self.sink.wants_members(&name);
            let inlet_full = self.dropped.load(Ordering::Relaxed);
            self.enqueue(&name, Task::Report { want_members, queue_depth, queue_full, inlet_full });
        }
    }
}

fn work_through(bed: &mut Bed, tasks: Vec<(Task, ArrivalTime)>, workers: &Workers, sink: &dyn Sink) {
    let mut outputs = Vec::new();
    for (task, arrived) in tasks {
        let health = bed.handle(task, arrived, workers, &mut outputs);
        if !outputs.is_empty() || health.is_some() {
            sink.put(bed, &outputs, health.as_ref());
            outputs.clear();
        }
    }
}
