//! iceoryx2's request and response, polled: the far end answers each request.

use crate::harness::{Batch, End, Plan, between_processes, next_run};
use crate::peers::iceoryx2_event::node;
use crate::shared::Shared;
use iceoryx2::active_request::ActiveRequest;
use iceoryx2::pending_response::PendingResponse;
use iceoryx2::port::client::Client;
use iceoryx2::port::server::Server;
use iceoryx2::prelude::*;
use iceoryx2::service::port_factory::request_response::PortFactory;
use std::hint::spin_loop;
use std::io;

type Error = Box<dyn core::error::Error>;

struct Asks {
    client: Client<ipc::Service, u32, (), u32, ()>,
    pending: Option<PendingResponse<ipc::Service, u32, (), u32, ()>>,
    _node: Node<ipc::Service>,
}

struct Answers {
    server: Server<ipc::Service, u32, (), u32, ()>,
    request: Option<ActiveRequest<ipc::Service, u32, (), u32, ()>>,
    _node: Node<ipc::Service>,
}

impl End for Asks {
    fn send(&mut self, stamp: u32) {
        self.pending = self.client.send_copy(stamp).ok();
    }

    fn receive(&mut self) -> u32 {
        loop {
            let pending = self.pending.as_ref();
            if let Some(Ok(Some(response))) = pending.map(|pending| pending.receive()) {
                return *response;
            }
            spin_loop();
        }
    }
}

impl End for Answers {
    fn send(&mut self, stamp: u32) {
        if let Some(request) = self.request.take() {
            let _ = request.send_copy(stamp);
        }
    }

    fn receive(&mut self) -> u32 {
        loop {
            if let Ok(Some(request)) = self.server.receive() {
                let stamp = *request;
                self.request = Some(request);
                return stamp;
            }
            spin_loop();
        }
    }
}

type Service = PortFactory<ipc::Service, u32, (), u32, ()>;

fn open<T>(
    shared: &Shared,
    run: u32,
    end: impl FnOnce(Node<ipc::Service>, Service) -> Result<T, Error>,
) -> T {
    let open = || -> Result<T, Error> {
        let node = node::<ipc::Service>()?;
        let name = ServiceName::new(&format!("tandem-bench/{run}/request"))?;
        let service = node.service_builder(&name).request_response::<u32, u32>();
        end(node, service.open_or_create()?)
    };
    let end =
        open().unwrap_or_else(|error| panic!("iceoryx2 request-response cannot start: {error}"));
    // Both have their ports before the first request.
    shared.meet(2);
    end
}

/// 4 bytes as a request, and 4 bytes as its response.
///
/// # Errors
/// As [`between_processes`].
pub fn iceoryx2_request(plan: &Plan) -> io::Result<Batch> {
    let run = next_run();
    let asks = move |shared: &Shared| {
        open(shared, run, |node, service| {
            Ok(Asks {
                client: service.client_builder().create()?,
                pending: None,
                _node: node,
            })
        })
    };
    let answers = move |shared: &Shared| {
        open(shared, run, |node, service| {
            Ok(Answers {
                server: service.server_builder().create()?,
                request: None,
                _node: node,
            })
        })
    };
    between_processes(plan, 0, asks, answers)
}
