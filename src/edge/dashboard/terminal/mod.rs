//! The terminal dashboard: a bedside monitor for every bed on the bus.
//!
//! [`run`] owns the terminal and asks the clock; `ward` is what is known, `ui` what is chosen, `view` a pure function
//! of both and of the time. What is published is what the person at the keyboard says: notes and acknowledgements, by
//! `errand` on a thread beside the screen.

mod alarms;
mod bedside;
mod columns;
mod group;
mod header;
mod health;
mod keys;
mod list;
mod log;
mod order;
mod paper;
mod parameters;
mod pause;
mod prompt;
mod sources;
mod style;
#[cfg(test)]
mod tests;
mod traces;
mod ui;
mod urgency;
mod values;
mod view;

use std::io;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::sync::mpsc::{Receiver, SyncSender, TryRecvError, sync_channel};
use std::thread;
use std::time::Duration;

use ratatui::DefaultTerminal;
use ratatui::crossterm::event::{self, Event};

use self::ui::{Next, Ui};
use super::errand::{self, Errand, Outcome};
use super::feed::{self, QUEUE, Topics};
use super::ward::{Memory, Ward};
use crate::edge::bus::{Bus, Message};
use crate::edge::config::Config;
use crate::runtime::clock::Clock;

/// Longest past of the waveforms \[s\].
const HISTORY_S: i64 = 60;
/// About 80 MB.
const MEMORY: Memory = Memory { history_s: HISTORY_S, rows: 200_000 };
/// Time between two pictures.
const FRAME: Duration = Duration::from_millis(55);
/// Longest work on messages between two pictures, so that keys are obeyed under any load.
const SHARE: Duration = Duration::from_millis(30);

/// Shows the beds of a daemon with this configuration, `bed` first, until a key or `stop` ends it; `author` signs notes
/// and acknowledgements.
///
/// # Errors
/// When the bus refuses the subscription or the terminal does not work.
pub fn run(bus: &dyn Bus, config: &Config, bed: Option<&str>, author: &str, stop: &AtomicBool) -> io::Result<()> {
    let prefix = config.publish.prefix.as_str();
    let dropped = Arc::new(AtomicU64::new(0));
    let (sender, receiver) = sync_channel(QUEUE);
    let _subscriptions = feed::subscribe(bus, prefix, Topics::All, &sender, &dropped).map_err(io::Error::other)?;
    let (last_sender, last_values) = sync_channel(1);
    let (errands, errands_to_run) = sync_channel(errand::QUEUE);
    let (outcome_sender, outcomes) = sync_channel(errand::QUEUE);
    thread::scope(|scope| {
        // Beside the screen, which does not wait for an answer that may never come.
        scope.spawn(move || {
            let _ = last_sender.send(feed::last_values(bus, prefix));
        });
        scope.spawn(move || {
            errand::serve(bus, prefix.trim_end_matches('/'), author, &errands_to_run, &outcome_sender);
        });
        let feed = Feed { receiver, last_values: Some(last_values), dropped };
        // Restores the terminal whichever way this ends.
        let _restore = Restore;
        let mut terminal = ratatui::try_init()?;
        let (ward, ui) = (Ward::of(config, MEMORY), Ui::new(bed));
        Screen { ward, ui, feed, errands, outcomes, clock: Clock::start() }.run(&mut terminal, stop)
    })
}

struct Restore;

impl Drop for Restore {
    fn drop(&mut self) {
        ratatui::restore();
    }
}

/// Where messages come from.
struct Feed {
    receiver: Receiver<Message>,
    /// The answer to the request for last values, until it is there.
    last_values: Option<Receiver<Vec<Message>>>,
    dropped: Arc<AtomicU64>,
}

struct Screen {
    ward: Ward,
    ui: Ui,
    feed: Feed,
    errands: SyncSender<Errand>,
    outcomes: Receiver<Outcome>,
    clock: Clock,
}

impl Screen {
    /// Time since the screen was opened.
    fn now(&self) -> Duration {
        Duration::from_nanos(self.clock.now().0.unsigned_abs())
    }

    fn run(&mut self, terminal: &mut DefaultTerminal, stop: &AtomicBool) -> io::Result<()> {
        while !stop.load(Ordering::Relaxed) {
            let frame_start = self.now();
            self.take_messages(frame_start);
            let now = self.now();
            while let Ok(outcome) = self.outcomes.try_recv() {
                self.ui.say(outcome, now);
            }
            terminal.draw(|frame| view::draw(frame, &self.ward, &self.ui, now))?;
            if self.obey_keys(frame_start)? == Next::Quit {
                break;
            }
        }
        Ok(())
    }

    fn take_messages(&mut self, frame_start: Duration) {
        self.ui.is_connecting = self.feed.last_values.is_some();
        self.ui.dropped = self.feed.dropped.load(Ordering::Relaxed);
        if let Some(last_values) = &self.feed.last_values {
            // News waits for the last values: what is older must come first.
            let messages = match last_values.try_recv() {
                Err(TryRecvError::Empty) => return,
                answer => answer.unwrap_or_default(),
            };
            for message in messages {
                self.ward.apply_last_value(&message);
            }
            self.feed.last_values = None;
        }
        loop {
            let now = self.now();
            if now.saturating_sub(frame_start) >= SHARE {
                break;
            }
            let Ok(message) = self.feed.receiver.try_recv() else { break };
            self.ward.apply(&message, now);
        }
    }

    fn tell(&mut self, errand: Errand, now: Duration) {
        if self.errands.try_send(errand).is_err() {
            let text = format!("not sent: {} messages wait for the daemon already", errand::QUEUE);
            self.ui.say(Outcome { text, is_failure: true }, now);
        }
    }

    /// Obeys keys until the next picture is due.
    fn obey_keys(&mut self, frame_start: Duration) -> io::Result<Next> {
        loop {
            let left = (frame_start + FRAME).saturating_sub(self.now());
            if !event::poll(left)? {
                return Ok(Next::Continue);
            }
            if let Event::Key(key) = event::read()? {
                let now = self.now();
                match self.ui.press(key, &self.ward, now) {
                    Next::Continue => {}
                    Next::Quit => return Ok(Next::Quit),
                    Next::Tell(errand) => self.tell(errand, now),
                }
            } else {
                return Ok(Next::Continue);
            }
        }
    }
}
