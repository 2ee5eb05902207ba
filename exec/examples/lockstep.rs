//! Three clients compute the same in lockstep; one of them becomes wrong, and is excluded.
//! `cargo run -p tandem-exec --example lockstep`
#![allow(clippy::print_stdout, reason = "its output is its purpose")]

use std::error::Error;
use tandem_board::{Duration, Instant};
use tandem_exec::client::{Client, Standing};
use tandem_exec::lockstep::OutputDigest;
use tandem_exec::master::{Config, MasterCore};
use tandem_exec::message::ClientId;

const MS: fn(u64) -> Duration = Duration::from_ms;

fn main() -> Result<(), Box<dyn Error>> {
    let config = Config {
        clients: 3,
        quorum: 2,
        candidates: 1,
        period: MS(10),
        lead: MS(1),
        wait: MS(2),
        patience: MS(100),
        takeover: MS(5),
    };
    let ids: Vec<ClientId> = ClientId::first(3).collect();
    let mut master = MasterCore::new(config, ids[0]).ok_or("the configuration is not valid")?;
    let mut clients: Vec<Client> = ids.iter().map(|id| Client::new(*id, 1)).collect();
    let (mut now, mut excluded) = (Instant::ORIGIN, None);
    while excluded.is_none() && now < Instant::ORIGIN + MS(200) {
        for client in &mut clients {
            if let Some(activated) = client.activate(now) {
                let mut output = OutputDigest::NONE;
                output.add(client.random() as u32);
                // From the sixth activation on, the last client has a wrong bit.
                output.add(u32::from(activated.cycle > 5 && client.id() == ids[2]));
                if activated.standing == Standing::Excluded {
                    excluded = Some(client.id().index());
                }
                println!("{now:?} {}: {:?}", client.id().index(), activated.code);
                let request = client.request(output.digest());
                master.on_request(now, client.id(), &request, &mut |event| {
                    println!("{event:?}")
                });
            } else if now == Instant::ORIGIN {
                master.on_request(now, client.id(), &client.request(0), &mut |_| ());
            }
        }
        // Beside others, the transport would decide which candidate's answer counts.
        if let Some(response) = master.poll(now).propose {
            master.on_decided(&response, &mut |event| println!("{event:?}"));
            for client in &mut clients {
                client.on_response(now, &response)?;
            }
        }
        now += MS(1);
    }
    assert_eq!(excluded, Some(2));
    Ok(())
}
