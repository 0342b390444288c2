//! `hemostream acknowledge`: tells the daemon that an alarm was seen.

use clap::Args;
use hemostream::edge::operator::Operator;
use hemostream::edge::zenoh::ZenohBus;

use super::replay::client_settings;
use super::serve::tokio_runtime;
use super::{ConfigArgs, Failure, say};

/// Tell the daemon that an alarm of a bed, or all of them, was seen
#[derive(Args)]
#[command(after_help = "Example:  hemostream acknowledge --bed bed1 --alarm \"low output\" --author \"Dr. Weber\"")]
pub(crate) struct Acknowledge {
    /// The bed
    #[arg(long)]
    bed: String,
    /// Name of the alarm; all of the bed where left out
    #[arg(long, value_name = "NAME")]
    alarm: Option<String>,
    /// Who has seen it
    #[arg(long, default_value = "")]
    author: String,
    #[command(flatten)]
    config: ConfigArgs,
    /// Where the daemon listens; over `zenoh.connect` of the configuration
    #[arg(long, value_name = "ENDPOINT")]
    connect: Vec<String>,
}

impl Acknowledge {
    pub(crate) fn run(&self) -> Result<(), Failure> {
        let (config, _) = self.config.load()?;
        let runtime = tokio_runtime()?;
        let settings = client_settings(&config, &self.connect);
        let bus = runtime.block_on(async { ZenohBus::open(&settings) })?;
        let operator = Operator { bus: &bus, prefix: &config.publish.prefix, bed: &self.bed };
        let acknowledged = operator.acknowledge(self.alarm.as_slice(), &self.author);
        bus.close();
        let acknowledged = acknowledged?;
        for alarm in &acknowledged {
            say(format!("acknowledged: {} ({})", alarm.name, alarm.text));
        }
        if acknowledged.is_empty() {
            say(match &self.alarm {
                Some(name) => format!("nothing to acknowledge: \"{name}\" is not raised, or was seen before"),
                None => "nothing to acknowledge: no alarm is raised that nobody has seen".to_owned(),
            });
        }
        Ok(())
    }
}
