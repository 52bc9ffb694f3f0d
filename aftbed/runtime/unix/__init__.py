"""The runtime on real Unix processes. Which process runs what:

| process            | modules                                                                            |
|--------------------|------------------------------------------------------------------------------------|
| command            | launch, options, run_directory, control_client, closed_loop, worker_pool, doctor   |
| supervisor to be   | head_start, supervisor_process                                                     |
| supervisor         | supervisor, event_loop, process_pool, workload, control_server, process_memory     |
| zygote and spares  | zygote, rehearsal                                                                  |
| node               | node_io, devices, death_notice, journal_files                                      |
| hub, car, player   | bus_services                                                                       |
| warden             | cleanup                                                                            |
| all                | linux, transport                                                                   |
"""
