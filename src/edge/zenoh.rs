//! The bus on zenoh. Mode, endpoints and scouting are always explicit: nothing is listened to or searched for
//! that the configuration does not name.

use std::collections::HashMap;
use std::sync::mpsc::{Receiver, SyncSender, sync_channel};
use std::sync::{Arc, Mutex, PoisonError};
use std::time::Duration;

use zenoh::Wait;
use zenoh::bytes::Encoding as ZenohEncoding;
use zenoh::pubsub::Publisher;
use zenoh::qos::{CongestionControl, Priority};
use zenoh::query::{ConsolidationMode, Query};
use zenoh::sample::Sample;

use super::bus::{Bus, BusError, Delivery, Encoding, Handler, LastValues, Message, Subscription, check_key};
use super::config::{ZenohMode, ZenohSettings};

/// Requests for last values that may wait; more are not answered.
const MAX_WAITING_QUERIES: usize = 256;

/// Keys whose publishers are kept declared. If there are more, as beds come and go for months, all are let go, and those
/// in use are declared again.
const MAX_PUBLISHERS: usize = 16_384;

/// Publishers of a key: what congestion does to a message is a matter of its publisher, so that there is one for each
/// [`Delivery`] in use.
#[derive(Default)]
struct Publishers([Option<Arc<Publisher<'static>>>; 3]);

impl Publishers {
    fn of(&mut self, delivery: Delivery) -> &mut Option<Arc<Publisher<'static>>> {
        &mut self.0[delivery as usize]
    }
}

/// A zenoh session as a bus.
#[derive(Clone)]
pub struct ZenohBus {
    session: zenoh::Session,
    publishers: Arc<Mutex<HashMap<String, Publishers>>>,
}

fn transport(error: impl std::fmt::Display) -> BusError {
    BusError::Transport(error.to_string())
}

impl ZenohBus {
    /// Opens a session.
    ///
    /// # Errors
    /// When an endpoint is not valid, taken, or cannot be reached.
    pub fn open(settings: &ZenohSettings) -> Result<Self, BusError> {
        let mode = match settings.mode {
            ZenohMode::Peer => "peer",
            ZenohMode::Client => "client",
            ZenohMode::Router => "router",
        };
        let listen = serde_json::json!(settings.listen).to_string();
        let connect = serde_json::json!(settings.connect).to_string();
        // Samples are sent one by one. A client has nothing better to do than to wait a moment until the link takes them;
        // a daemon must not let one subscriber that hangs hold up the others.
        let patience_us = if settings.mode == ZenohMode::Client { "50000" } else { "1000" };
        let mut config = zenoh::Config::default();
        for (key, value) in [
            ("mode", format!("\"{mode}\"").as_str()),
            ("listen/endpoints", listen.as_str()),
            ("connect/endpoints", connect.as_str()),
            ("scouting/multicast/enabled", "false"),
            ("scouting/gossip/enabled", "false"),
            ("transport/shared_memory/enabled", "false"),
            ("transport/link/tx/queue/size/real_time", "16"),
            ("transport/link/tx/queue/congestion_control/drop/wait_before_drop", patience_us),
        ] {
            config.insert_json5(key, value).map_err(|e| transport(format!("{key} = {value}: {e}")))?;
        }
        let session = zenoh::open(config)
            .wait()
            .map_err(|e| transport(format!("cannot open a session (listen {listen}, connect {connect}): {e}")))?;
        Ok(Self { session, publishers: Arc::default() })
    }

    /// Closes the session; waits at most a few seconds.
    pub fn close(&self) {
        self.publishers.lock().unwrap_or_else(PoisonError::into_inner).clear();
        // On a lossy link closing may take long; it is bounded by leaving it to a thread of its own.
        let session = self.session.clone();
        let (done, closed) = sync_channel(1);
        std::thread::spawn(move || {
            let _ = session.close().wait();
            let _ = done.send(());
        });
        let _ = closed.recv_timeout(Duration::from_secs(3));
    }

    fn publisher(&self, key: &str, delivery: Delivery) -> Result<Arc<Publisher<'static>>, BusError> {
        let mut publishers = self.publishers.lock().unwrap_or_else(PoisonError::into_inner);
        if let Some(publisher) = publishers.get_mut(key).and_then(|known| known.of(delivery).clone()) {
            return Ok(publisher);
        }
        check_key(key)?;
        let (congestion, priority) = match delivery {
            Delivery::Samples => (CongestionControl::Drop, Priority::RealTime),
            Delivery::Estimates => (CongestionControl::Drop, Priority::DataHigh),
            Delivery::Events => (CongestionControl::Block, Priority::InteractiveHigh),
        };
        let publisher = self
            .session
            .declare_publisher(key.to_owned())
            .congestion_control(congestion)
            .priority(priority)
            .express(delivery == Delivery::Samples)
            .wait()
            .map_err(transport)?;
        let publisher = Arc::new(publisher);
        let is_full = publishers.len() >= MAX_PUBLISHERS && !publishers.contains_key(key);
        let let_go = if is_full { std::mem::take(&mut *publishers) } else { HashMap::new() };
        *publishers.entry(key.to_owned()).or_default().of(delivery) = Some(Arc::clone(&publisher));
        drop(publishers);
        // Undeclaring takes a moment, for which nobody is to wait.
        drop(let_go);
        Ok(publisher)
    }

    /// Any publisher of a key.
    fn some_publisher(&self, key: &str) -> Result<Arc<Publisher<'static>>, BusError> {
        let declared = {
            let publishers = self.publishers.lock().unwrap_or_else(PoisonError::into_inner);
            publishers.get(key).and_then(|known| known.0.iter().flatten().next().cloned())
        };
        declared.map_or_else(|| self.publisher(key, Delivery::Estimates), Ok)
    }
}

fn to_zenoh(encoding: Encoding) -> ZenohEncoding {
    match encoding {
        Encoding::Bincode => ZenohEncoding::APPLICATION_OCTET_STREAM.with_schema("hemostream-bincode-1"),
        Encoding::Json => ZenohEncoding::APPLICATION_JSON,
    }
}

fn message(sample: &Sample) -> Message {
    let encoding = sample.encoding().to_string();
    let json = encoding.starts_with("application/json") || encoding.starts_with("text/json");
    Message {
        key: sample.key_expr().as_str().to_owned(),
        encoding: if json { Encoding::Json } else { Encoding::Bincode },
        payload: sample.payload().to_bytes().into_owned(),
    }
}

impl Bus for ZenohBus {
    fn publish(&self, message: Message, delivery: Delivery) -> Result<(), BusError> {
        let publisher = self.publisher(&message.key, delivery)?;
        publisher.put(message.payload).encoding(to_zenoh(message.encoding)).wait().map_err(transport)
    }

    fn is_connected(&self) -> bool {
        let info = self.session.info();
        info.routers_zid().wait().next().is_some() || info.peers_zid().wait().next().is_some()
    }

    fn is_wanted(&self, key: &str) -> bool {
        let publisher = self.some_publisher(key);
        publisher.is_ok_and(|p| p.matching_status().wait().is_ok_and(|status| status.matching()))
    }

    fn subscribe(&self, pattern: &str, handler: Handler) -> Result<Subscription, BusError> {
        check_key(pattern)?;
        let subscriber = self
            .session
            .declare_subscriber(pattern.to_owned())
            .callback(move |sample| handler(message(&sample)))
            .wait()
            .map_err(transport)?;
        Ok(Subscription::new(subscriber))
    }

    fn offer_last_values(&self, pattern: &str, answer: LastValues) -> Result<Subscription, BusError> {
        check_key(pattern)?;
        // Replying may block, a callback must not: the answers come from a thread of their own.
        let (queries, waiting): (SyncSender<Query>, Receiver<Query>) = sync_channel(MAX_WAITING_QUERIES);
        std::thread::Builder::new()
            .name("last-values".to_owned())
            .spawn(move || {
                for query in waiting {
                    for m in answer(query.key_expr().as_str()) {
                        let _ = query.reply(m.key, m.payload).encoding(to_zenoh(m.encoding)).wait();
                    }
                }
            })
            .map_err(transport)?;
        let queryable = self
            .session
            .declare_queryable(pattern.to_owned())
            .callback(move |query| {
                let _ = queries.try_send(query);
            })
            .wait()
            .map_err(transport)?;
        Ok(Subscription::new(queryable))
    }

    fn last_values(&self, pattern: &str, timeout: Duration) -> Result<Vec<Message>, BusError> {
        check_key(pattern)?;
        let replies = self
            .session
            .get(pattern.to_owned())
            .consolidation(ConsolidationMode::None)
            // Answers have that of the question: behind estimates those who miss some would wait until there are no more.
            .priority(Priority::InteractiveHigh)
            .timeout(timeout)
            .wait()
            .map_err(transport)?;
        let mut messages = Vec::new();
        while let Ok(reply) = replies.recv() {
            if let Ok(sample) = reply.result() {
                messages.push(message(sample));
            }
        }
        Ok(messages)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn being_asked_whether_a_message_is_wanted_does_not_change_how_it_is_delivered() {
        let settings = ZenohSettings { mode: ZenohMode::Peer, listen: Vec::new(), connect: Vec::new() };
        let bus = ZenohBus::open(&settings).unwrap();
        let (heard, samples) = sync_channel(3);
        let hear = move |sample: Sample| {
            let _ = heard.send((sample.congestion_control(), sample.express()));
        };
        let _subscriber = bus.session.declare_subscriber("ward/**").callback(hear).wait().unwrap();
        for (delivery, expected) in [
            (Delivery::Estimates, (CongestionControl::Drop, false)),
            (Delivery::Events, (CongestionControl::Block, false)),
            (Delivery::Samples, (CongestionControl::Drop, true)),
        ] {
            let key = "ward/bed1/event".to_owned();
            assert!(bus.is_wanted(&key));
            bus.publish(Message { key, encoding: Encoding::Json, payload: b"{}".to_vec() }, delivery).unwrap();
            assert_eq!(samples.recv_timeout(Duration::from_secs(5)).unwrap(), expected, "{delivery:?}");
        }
        bus.close();
    }
}
