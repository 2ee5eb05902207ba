//! A service of iceoryx2 like `ipc::Service`, except that its events use a semaphore in shared
//! memory instead of a Unix datagram socket. Both mechanisms are iceoryx2's own.

use core::fmt::Debug;
use iceoryx2::service::{Service, internal, ipc};
use iceoryx2_bb_elementary_traits::testing::abandonable::Abandonable;
use iceoryx2_bb_elementary_traits::zero_copy_send::ZeroCopySend;
use iceoryx2_cal::event::SemaphoreShmCountingBitSet;

/// Like `ipc::Service`, with other events.
#[derive(Clone, Debug)]
pub(super) struct BySemaphore;

impl Service for BySemaphore {
    type Event = SemaphoreShmCountingBitSet;

    type StaticStorage = <ipc::Service as Service>::StaticStorage;
    type ConfigSerializer = <ipc::Service as Service>::ConfigSerializer;
    type PersistentDynamicStorage<T: Debug + Send + Sync + ZeroCopySend + 'static> =
        <ipc::Service as Service>::PersistentDynamicStorage<T>;
    type Bag = <ipc::Service as Service>::Bag;
    type DynamicStorage<T: Debug + Send + Sync + ZeroCopySend + 'static> =
        <ipc::Service as Service>::DynamicStorage<T>;
    type ServiceNameHasher = <ipc::Service as Service>::ServiceNameHasher;
    type SharedMemory = <ipc::Service as Service>::SharedMemory;
    type ResizableSharedMemory = <ipc::Service as Service>::ResizableSharedMemory;
    type Connection = <ipc::Service as Service>::Connection;
    type Monitoring = <ipc::Service as Service>::Monitoring;
    type Reactor = <ipc::Service as Service>::Reactor;
    type ArcThreadSafetyPolicy<T: Send + Debug + Abandonable> =
        <ipc::Service as Service>::ArcThreadSafetyPolicy<T>;
    type BlackboardMgmt<KeyType: Send + Sync + Debug + ZeroCopySend + 'static> =
        <ipc::Service as Service>::BlackboardMgmt<KeyType>;
    type BlackboardPayload = <ipc::Service as Service>::BlackboardPayload;
    type UniqueId = <ipc::Service as Service>::UniqueId;
}

impl internal::ServiceInternal<Self> for BySemaphore {}
