//! The event loop: beds appear, take turns on the worker pool, and report.

use std::collections::{BTreeMap, VecDeque};
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::Duration;

use tokio::sync::mpsc;

use super::bed::{Account, Bed, Health, Task};
use super::clock::Clock;
use super::governor::{self, Governor};
use super::workers::Workers;
use crate::estimate::ensemble::{Parallel, Serial};
use crate::estimate::estimator::{Estimator, Output};
use crate::estimate::settings::{EstimatorSettings, SettingsError};
use crate::estimate::time::ArrivalTime;
use crate::model::discrepancy::Circulation;

/// How often beds without input are told that time has passed.
const TICK: Duration = Duration::from_millis(20);

/// With more beds than workers, what comes in for a bed is gathered for this long: the blocks of several sensors, which
/// close windows only together, take one turn then, and not one each.
const GATHER: Duration = Duration::from_millis(2);

/// [`governor::SETTLED`] \[ns\].
const SETTLED_NS: i64 = governor::SETTLED.as_millis() as i64 * 1_000_000;

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

    /// A bed was let go; what is remembered of it can be forgotten.
    fn gone(&self, _bed: &str) {}
}

/// Limits of the service.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Limits {
    /// Beds kept; messages of others are counted and dropped.
    pub max_beds: usize,
    /// A bed that has had no samples for so long makes room for a new one where there are as many as there may be.
    pub forget_after: Duration,
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
    /// When something last came in for it.
    heard: ArrivalTime,
    /// Share of the members that it was told to go on with.
    share: f64,
}

impl Slot {
    fn account(&self, account: &mut Account) {
        account.lost = account.lost.saturating_add(self.queue_full);
        self.bed.iter().for_each(|bed| bed.account(account));
    }
}

/// The service.
pub struct Service {
    /// Every bed begins as its clone.
    estimator: Estimator<Circulation>,
    limits: Limits,
    workers: Arc<Workers>,
    sink: Arc<dyn Sink>,
    clock: Clock,
    events: mpsc::Receiver<Event>,
    returns: mpsc::UnboundedSender<Event>,
    returned: mpsc::UnboundedReceiver<Event>,
    beds: BTreeMap<String, Slot>,
    /// Beds that workers have.
    away: usize,
    /// Whether some bed gathers.
    gathering: bool,
    governor: Governor,
    /// Time that workers have spent, and when that was looked at last.
    busy_ns: Arc<AtomicU64>,
    looked: (ArrivalTime, u64),
    /// When the last new bed appeared.
    newest: Option<ArrivalTime>,
    too_many_beds: u64,
    /// Messages of unknown beds that nobody understood.
    not_understood: u64,
    /// What beds did that were let go.
    gone: Account,
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
        let estimator = Estimator::new(model, settings)?;
        let (sender, events) = mpsc::channel(limits.queue_tasks.saturating_mul(16).clamp(1024, 65_536));
        // Unbounded in type only: there is at most one return per bed.
        let (returns, returned) = mpsc::unbounded_channel();
        let inlet = Inlet { events: sender, dropped: Arc::default() };
        let service = Self {
            estimator,
            limits,
            workers,
            sink,
            clock,
            events,
            returns,
            returned,
            beds: BTreeMap::new(),
            away: 0,
            gathering: false,
            governor: Governor::default(),
            busy_ns: Arc::default(),
            looked: (clock.now(), 0),
            newest: None,
            too_many_beds: 0,
            not_understood: 0,
            gone: Account::default(),
            dropped: Arc::clone(&inlet.dropped),
        };
        Ok((service, inlet))
    }

    /// Runs until it is told to stop; what is waiting then is still done. Returns what was done.
    pub async fn run(mut self) -> Account {
        let mut tick = tokio::time::interval(TICK);
        tick.set_missed_tick_behavior(tokio::time::MissedTickBehavior::Skip);
        let mut report = tokio::time::interval(self.limits.report_every);
        report.set_missed_tick_behavior(tokio::time::MissedTickBehavior::Skip);
        let mut look = tokio::time::interval(governor::PERIOD);
        look.set_missed_tick_behavior(tokio::time::MissedTickBehavior::Skip);
        let mut gather = tokio::time::interval(GATHER / 2);
        gather.set_missed_tick_behavior(tokio::time::MissedTickBehavior::Skip);
        let mut stopping = false;
        while !(stopping && self.is_idle()) {
            tokio::select! {
                biased;
                Some(event) = self.returned.recv() => self.take_back(event),
                // Before what comes in, which may never end.
                _ = look.tick() => self.look(),
                _ = tick.tick(), if !stopping => self.tick(),
                _ = report.tick(), if !stopping => self.report(),
                _ = gather.tick(), if self.gathering => self.dispatch(),
                Some(event) = self.events.recv(), if !stopping => match event {
                    Event::Task { bed, task } => self.enqueue(&bed, task),
                    Event::Stop => {
                        stopping = true;
                        self.report();
                    }
                    event @ (Event::Done(_) | Event::Lost(_)) => self.take_back(event),
                },
                else => break,
            }
        }
        let mut account = std::mem::take(&mut self.gone);
        account.lost = account.lost.saturating_add(self.dropped.load(Ordering::Relaxed));
        self.beds.values().for_each(|slot| slot.account(&mut account));
        account
    }

    /// How long tasks of a bed are gathered \[ns\].
    fn gather_ns(&self) -> i64 {
        let many = self.beds.len() > self.workers.threads();
        if many { i64::try_from(GATHER.as_nanos()).unwrap_or(0) } else { 0 }
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
                self.away -= 1;
                self.dispatch();
            }
            Event::Lost(name) => {
                self.sink.lost(&name);
                let bed = self.new_bed(&name);
                if let Some(slot) = self.beds.get_mut(&name) {
                    slot.bed = Some(bed);
                    slot.queue_full = slot.queue_full.saturating_add(slot.waiting.len() as u64);
                    slot.waiting.clear();
                    slot.share = 1.0;
                }
                self.away -= 1;
                self.dispatch();
            }
            Event::Task { .. } | Event::Stop => {}
        }
    }

    fn new_bed(&self, name: &str) -> Box<Bed> {
        Box::new(Bed::new(name.to_owned(), self.estimator.clone(), self.clock))
    }

    fn enqueue(&mut self, name: &str, task: Task) {
        let now = self.clock.now();
        if !self.beds.contains_key(name) {
            // What nobody understands makes no bed.
            if let Task::Refused(cause) = task {
                self.not_understood += 1;
                if self.not_understood.is_power_of_two() {
                    let so_far = self.not_understood;
                    tracing::warn!(bed = name, cause, so_far, "a message for an unknown bed was not understood");
                }
                return;
            }
            // A bed appears with its first sample; before that there is nothing to have seen.
            if let Task::Acknowledge { .. } = task {
                tracing::warn!(bed = name, "an alarm of an unknown bed was acknowledged");
                return;
            }
            if self.beds.len() >= self.limits.max_beds && !self.make_room(now) {
                self.too_many_beds += 1;
                if self.too_many_beds.is_power_of_two() {
                    tracing::warn!(bed = name, max_beds = self.limits.max_beds, "bed refused: too many beds");
                }
                return;
            }
            let bed = self.new_bed(name);
            tracing::info!(bed = name, "new bed");
            let slot =
                Slot { bed: Some(bed), waiting: VecDeque::new(), queue_full: 0, touched: now, heard: now, share: 1.0 };
            self.beds.insert(name.to_owned(), slot);
            self.newest = Some(now);
        }
        let limit = self.limits.queue_tasks;
        if let Some(slot) = self.beds.get_mut(name) {
            if matches!(task, Task::Samples { .. } | Task::Beats(_)) {
                slot.heard = now;
            }
            if slot.waiting.len() >= limit {
                slot.queue_full += 1;
            } else {
                slot.waiting.push_back((task, now));
                slot.touched = now;
            }
        }
        if self.gather_ns() > 0 {
            self.gathering = true;
        } else {
            self.dispatch();
        }
    }

    /// Lets the bed go that has been silent longest, if that is long enough; whether one went.
    fn make_room(&mut self, now: ArrivalTime) -> bool {
        let silence_ns = i64::try_from(self.limits.forget_after.as_nanos()).unwrap_or(i64::MAX);
        let is_forgotten = |slot: &Slot| slot.bed.is_some() && now.ns_since(slot.heard) >= silence_ns;
        let silent = self.beds.iter().filter(|(_, slot)| is_forgotten(slot));
        let Some(name) = silent.min_by_key(|(_, slot)| slot.heard).map(|(name, _)| name.clone()) else { return false };
        if let Some(slot) = self.beds.remove(&name) {
            slot.account(&mut self.gone);
        }
        self.sink.gone(&name);
        true
    }

    /// Hands beds to the workers, those first whose samples have waited longest: all windows have the same time to be
    /// solved in, so that the earliest deadline is that of the earliest arrival. One more than there are workers, so that
    /// none waits for this loop.
    fn dispatch(&mut self) {
        let (now, gather_ns) = (self.clock.now(), self.gather_ns());
        while self.away <= self.workers.threads() {
            let there = self.beds.iter_mut().filter(|(_, slot)| slot.bed.is_some());
            let first = there.filter_map(|(name, slot)| Some((slot.waiting.front()?.1, name, slot)));
            let first = first.min_by_key(|(arrived, name, _)| (*arrived, *name));
            // When the first is not ready yet, no other is.
            self.gathering = first.as_ref().is_some_and(|(arrived, ..)| now.ns_since(*arrived) < gather_ns);
            let Some((_, name, slot)) = first.filter(|_| !self.gathering) else { return };
            let Some(mut bed) = slot.bed.take() else { return };
            let mut tasks: Vec<_> = slot.waiting.drain(..slot.waiting.len().min(TURN)).collect();
            let share = self.governor.share();
            if share.to_bits() != slot.share.to_bits() {
                slot.share = share;
                tasks.insert(0, (Task::Share(share), tasks[0].1));
            }
            let (workers, sink, returns) = (Arc::clone(&self.workers), Arc::clone(&self.sink), self.returns.clone());
            let (name, clock, busy_ns) = (name.clone(), self.clock, Arc::clone(&self.busy_ns));
            // With a bed for every worker, sharing one out gains nothing.
            let shared_out = self.beds.len() < self.workers.threads();
            self.away += 1;
            self.workers.spawn(move || {
                let started = clock.now();
                let work = AssertUnwindSafe(|| {
                    let parallel: &dyn Parallel = if shared_out { workers.as_ref() } else { &Serial };
                    work_through(&mut bed, tasks, parallel, sink.as_ref());
                    bed
                });
                // A defect in one bed must not take the others with it.
                let event = catch_unwind(work).map_or_else(|_| Event::Lost(name), Event::Done);
                let spent = u64::try_from(clock.now().ns_since(started)).unwrap_or(0);
                busy_ns.fetch_add(spent, Ordering::Relaxed);
                // Let go before the bed is back: when the service has stopped, nobody is left who still publishes.
                drop((workers, sink));
                let _ = returns.send(event);
            });
        }
    }

    /// Sees whether the machine keeps up.
    #[allow(clippy::cast_precision_loss)]
    fn look(&mut self) {
        let (now, busy_ns) = (self.clock.now(), self.busy_ns.load(Ordering::Relaxed));
        let (before, busy_before) = std::mem::replace(&mut self.looked, (now, busy_ns));
        let available = now.ns_since(before) as f64 * self.workers.threads() as f64;
        let waits = self.beds.values().filter_map(|slot| Some(now.ns_since(slot.waiting.front()?.1)));
        let longest = Duration::from_nanos(u64::try_from(waits.max().unwrap_or(0)).unwrap_or(0));
        let busy = if available > 0.0 { (busy_ns - busy_before) as f64 / available } else { 0.0 };
        let beginning = self.newest.is_some_and(|newest| now.ns_since(newest) < SETTLED_NS);
        if let Some(share) = self.governor.look(longest, busy, beginning) {
            let (beds, waited_ms) = (self.beds.len(), longest.as_millis());
            if share < 1.0 {
                tracing::warn!(beds, share, busy, "overload: samples have waited {waited_ms} ms");
            } else {
                tracing::info!(beds, busy, "overload is over: all members take part again");
            }
        }
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

fn work_through(bed: &mut Bed, tasks: Vec<(Task, ArrivalTime)>, parallel: &dyn Parallel, sink: &dyn Sink) {
    let mut outputs = Vec::new();
    for (task, arrived) in tasks {
        let health = bed.handle(task, arrived, parallel, &mut outputs);
        if !outputs.is_empty() || health.is_some() {
            sink.put(bed, &outputs, health.as_ref());
            outputs.clear();
        }
        bed.handed_over();
    }
}
