//! dust_dds as a peer, in this process.

use crate::frame;
use crate::peer::{Reader, Writer};
use dust_dds::dds_async::data_reader::DataReaderAsync;
use dust_dds::dds_async::data_writer::DataWriterAsync;
use dust_dds::domain::domain_participant::DomainParticipant;
use dust_dds::domain::domain_participant_factory::DomainParticipantFactory;
use dust_dds::infrastructure::error::DdsError;
use dust_dds::infrastructure::listener::NO_LISTENER;
use dust_dds::infrastructure::qos::{DataReaderQos, DataWriterQos, QosKind};
use dust_dds::infrastructure::qos_policy::{
    DurabilityQosPolicy, DurabilityQosPolicyKind, HistoryQosPolicy, HistoryQosPolicyKind,
    ReliabilityQosPolicy, ReliabilityQosPolicyKind,
};
use dust_dds::infrastructure::sample_info::{ANY_INSTANCE_STATE, ANY_SAMPLE_STATE, ANY_VIEW_STATE};
use dust_dds::infrastructure::status::{
    NO_STATUS, OfferedIncompatibleQosStatus, RequestedIncompatibleQosStatus, StatusKind,
};
use dust_dds::infrastructure::time::{Duration, DurationKind};
use dust_dds::infrastructure::type_support::DdsType;
use dust_dds::publication::data_writer::DataWriter;
use dust_dds::publication::data_writer_listener::DataWriterListener;
use dust_dds::subscription::data_reader::DataReader;
use dust_dds::subscription::data_reader_listener::DataReaderListener;
use dust_dds::topic_definition::topic::Topic;
use std::sync::Arc;
use std::sync::atomic::{AtomicU32, Ordering};
use tandem_topics::{Durability, Qos, Reliability};

/// A write of a reliable writer blocks at most for this time, until its oldest sample is
/// acknowledged.
const BLOCKS: DurationKind = DurationKind::Finite(Duration::new(1, 0));

#[derive(DdsType)]
#[dust_dds(name = "tandem::CanFrame")]
struct CanFrame {
    id: u32,
    period_ms: u16,
    length: u8,
    data: [u8; frame::DATA],
}

impl CanFrame {
    fn of(number: u32) -> Self {
        Self {
            id: number,
            period_ms: frame::PERIOD_MS,
            length: frame::DATA as u8,
            data: frame::data(number),
        }
    }

    fn number(&self) -> u32 {
        let expected = Self::of(self.id);
        let (length, data) = (expected.length, expected.data);
        assert_eq!((self.period_ms, self.length), (expected.period_ms, length));
        assert_eq!(self.data, data);
        self.id
    }
}

const fn reliability(qos: Qos) -> ReliabilityQosPolicy {
    ReliabilityQosPolicy {
        kind: match qos.reliability {
            Reliability::Reliable => ReliabilityQosPolicyKind::Reliable,
            Reliability::BestEffort => ReliabilityQosPolicyKind::BestEffort,
        },
        max_blocking_time: BLOCKS,
    }
}

const fn durability(qos: Qos) -> DurabilityQosPolicy {
    DurabilityQosPolicy {
        kind: match qos.durability {
            Durability::TransientLocal => DurabilityQosPolicyKind::TransientLocal,
            Durability::Volatile => DurabilityQosPolicyKind::Volatile,
        },
    }
}

const fn history(qos: Qos) -> HistoryQosPolicy {
    HistoryQosPolicy {
        kind: HistoryQosPolicyKind::KeepLast(qos.depth as u32),
    }
}

fn participate(domain: u16) -> (DomainParticipant, Topic) {
    let factory = DomainParticipantFactory::get_instance();
    let participant = factory
        .create_participant(domain.into(), QosKind::Default, NO_LISTENER, NO_STATUS)
        .unwrap();
    let topic = participant.create_topic::<CanFrame>(
        frame::TOPIC,
        frame::TYPE,
        QosKind::Default,
        NO_LISTENER,
        NO_STATUS,
    );
    (participant, topic.unwrap())
}

/// Counts the ends of others that do not fit. Its methods that return the status panic.
#[derive(Clone, Default)]
struct Incompatible(Arc<AtomicU32>);

impl Incompatible {
    fn count(&self) -> u32 {
        self.0.load(Ordering::Relaxed)
    }
}

impl DataWriterListener<CanFrame> for Incompatible {
    async fn on_offered_incompatible_qos(
        &mut self,
        _writer: DataWriterAsync<CanFrame>,
        status: OfferedIncompatibleQosStatus,
    ) {
        self.0.store(status.total_count as u32, Ordering::Relaxed);
    }
}

impl DataReaderListener<CanFrame> for Incompatible {
    async fn on_requested_incompatible_qos(
        &mut self,
        _reader: DataReaderAsync<CanFrame>,
        status: RequestedIncompatibleQosStatus,
    ) {
        self.0.store(status.total_count as u32, Ordering::Relaxed);
    }
}

/// A participant with a writer.
pub(crate) struct DustWriter {
    writer: DataWriter<CanFrame>,
    incompatible: Incompatible,
}

impl DustWriter {
    pub(crate) fn open(domain: u16, qos: Qos) -> Self {
        let (participant, topic) = participate(domain);
        let qos = DataWriterQos {
            reliability: reliability(qos),
            durability: durability(qos),
            history: history(qos),
            ..Default::default()
        };
        let incompatible = Incompatible::default();
        let publisher = participant.create_publisher(QosKind::Default, NO_LISTENER, NO_STATUS);
        let writer = publisher.unwrap().create_datawriter(
            &topic,
            QosKind::Specific(qos),
            Some(incompatible.clone()),
            &[StatusKind::OfferedIncompatibleQos],
        );
        Self {
            writer: writer.unwrap(),
            incompatible,
        }
    }
}

impl Writer for DustWriter {
    fn write(&mut self, number: u32) -> bool {
        match self.writer.write(CanFrame::of(number), None) {
            Ok(()) => true,
            // It has blocked until now, and drops the frame.
            Err(DdsError::Timeout) => false,
            Err(error) => panic!("{error:?}"),
        }
    }

    fn incompatible(&mut self) -> u32 {
        self.incompatible.count()
    }
}

/// A participant with a reader.
pub(crate) struct DustReader {
    reader: DataReader<CanFrame>,
    incompatible: Incompatible,
}

impl DustReader {
    pub(crate) fn open(domain: u16, qos: Qos) -> Self {
        let (participant, topic) = participate(domain);
        let qos = DataReaderQos {
            reliability: reliability(qos),
            durability: durability(qos),
            history: history(qos),
            ..Default::default()
        };
        let incompatible = Incompatible::default();
        let subscriber = participant.create_subscriber(QosKind::Default, NO_LISTENER, NO_STATUS);
        let reader = subscriber.unwrap().create_datareader(
            &topic,
            QosKind::Specific(qos),
            Some(incompatible.clone()),
            &[StatusKind::RequestedIncompatibleQos],
        );
        Self {
            reader: reader.unwrap(),
            incompatible,
        }
    }
}

impl Reader for DustReader {
    fn take(&mut self) -> Vec<u32> {
        let samples = self
            .reader
            .take(1_000, ANY_SAMPLE_STATE, ANY_VIEW_STATE, ANY_INSTANCE_STATE);
        match samples {
            Ok(samples) => {
                let frames = samples.iter().filter_map(|sample| sample.data.as_ref());
                frames.map(CanFrame::number).collect()
            }
            Err(DdsError::NoData) => Vec::new(),
            Err(error) => panic!("{error:?}"),
        }
    }

    fn incompatible(&mut self) -> u32 {
        self.incompatible.count()
    }
}
